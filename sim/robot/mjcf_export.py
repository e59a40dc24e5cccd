"""MJCF of the simulated robot, with motors, or with servos that have the gains of a law or a drive.

Each independent joint has one actuator: ``<motor>``, whose input in ``ctrl`` is the effort, or
``<position>``, whose input is the setpoint g::

    effort = kp (g - q) - kd q'

Limits of the effort are the joints' (``actuatorfrcrange``): each joint has one actuator.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from lxml import etree
from numpy.typing import ArrayLike

from batchpid.arrays.array_types import Float64, MjModel, MjSpec
from batchpid.errors import RobotError
from batchpid.export.differences import Exported, Law, differences, export_law
from batchpid.law.params import PIDParams, make_params
from batchpid.motors.friction import Friction
from batchpid.sim.engine.mujoco.model_builder import principal_inertia, robot_spec
from batchpid.sim.engine.scene_spec import SOLVERS, added_friction, own_friction
from batchpid.sim.geometry.shapes import nearest_physical
from batchpid.sim.robot.robot import Robot
from batchpid.sim.robot.robot_model import base_start
from batchpid.sim.robot.robot_options import scene_of
from batchpid.task_space.frames import SpatialInertia

_FAR = 1e10
"""Finite limit in place of an infinite one."""


def _numbers_text(*numbers: Float64 | float) -> str:
    """Return numbers with all digits."""
    return " ".join(repr(float(number)) for number in numbers)


def to_mjcf(
    robot: Robot,
    params: PIDParams | None,
    dt: float,
    *,
    inertia: ArrayLike | None = None,
) -> Exported:
    """Return the MJCF of ``robot``, one actuator for each independent joint, and its differences.

    Bodies are the rigid bodies that are simulated here, with repaired inertias, convex shapes,
    pairs that do not collide, joint limits, damping, Coulomb friction and armature, those of the
    robot's actuators included; followers are tied to their leaders by constraints. The keyframe
    "home" has the start pose as positions of base and joints, and as setpoints.

    Parameters
    ----------
    params
        Of one env, (1, joints), all joints: the gains of servos. None: motors, with the robot's
        effort limits.
    dt
        Time step of the simulation, and so of the control [s].
    inertia
        As in :func:`batchpid.export.to_ros2_control`, of all joints.

    Raises
    ------
    InvalidArgumentError
        Params for several envs, gains per mass matrix without ``inertia``, or limits that MuJoCo
        refuses.
    RobotError
        MuJoCo cannot build the robot.
    """
    servos = params is not None
    if params is None:
        limit = robot.effort_limit
        params = make_params(robot.dof, 0.0, effort_limit=limit, measurement_rate="measured")
    law = export_law(
        params,
        robot.joint_names,
        dt,
        inertia,
        robot.actuators,
    )
    sentences = differences(law, "mjcf", robot.independent)
    spec = scene_of(robot, law.dt, SOLVERS["accurate"], ground=robot.has_ground)
    # The bodies are those that the engine simulates; inertias and efforts are then written with all
    # their digits.
    scene, names = robot_spec(spec)
    scene.modelname = robot.name
    # Our engine switches off effects that the loop computes. Other programs need them.
    scene.option.disableflags = 0
    for row in spec.simulated.bodies:
        inertia_kept = _set_inertia(scene.body(names[row.name]), row.spatial_inertia)
        if not inertia_kept:
            text = f"the nearest possible tensor instead of that of link {row.name!r}"
            sentences.append(f"inertia: {text}")
    friction = added_friction(own_friction(spec), law.actuators)
    _set_joints(scene, robot, law, friction)
    if np.any(friction.coulomb):
        text = "a soft constraint in MuJoCo, in which a joint creeps under smaller efforts"
        sentences.append(f"friction: {text}")
    if followers := [robot.joint_names[joint] for joint in robot.coupling.followers]:
        sentences.append(f"followers: soft constraints in MuJoCo: {', '.join(followers)}")
    try:
        # Actuators are added to the text, which then has all their digits.
        scene.compile()
        root = _exact(scene)
        section = etree.SubElement(root, "actuator")
        kp, kv = law.column("kp"), law.column("kd")
        for at in np.flatnonzero(robot.independent):
            element = {"name": law.joints[at], "joint": law.joints[at]}
            if servos:
                element |= {"kp": _numbers_text(kp[at]), "kv": _numbers_text(kv[at])}
            etree.SubElement(section, "position" if servos else "motor", element)
        model = mujoco.MjModel.from_xml_string(etree.tostring(root, encoding="unicode"))
    except ValueError as error:
        raise RobotError(f"MuJoCo cannot build the robot: {error}; correct the URDF") from error
    # The model gives the sizes and places of the keyframe's rows.
    etree.SubElement(etree.SubElement(root, "keyframe"), "key", _start(model, robot, servos))
    etree.indent(root)
    # The tables of an MJCF robot hold the robot alone.
    if robot.mjcf is not None:
        text = "the robot alone, without objects, tendons, springs and equalities of its MJCF file"
        sentences.append(f"scene: {text}")
    head = "".join(f"<!-- differs: {text.replace('--', '- -')} -->\n" for text in sentences)
    return Exported(f"{head}{etree.tostring(root, encoding='unicode')}\n", tuple(sentences))


def _set_inertia(body: Any, inertia: SpatialInertia) -> bool:
    """Set the inertia of a body to the nearest of a physical body, which MuJoCo requires; return
    whether that is its own.
    """
    low, middle, high = np.linalg.eigvalsh(inertia.tensor)
    is_physical = low > 0 and low + middle >= high
    if not is_physical:
        inertia = inertia._replace(tensor=nearest_physical(inertia.tensor * (1 + 1e-9)))
    body.inertia, body.iquat = principal_inertia(inertia)
    return bool(is_physical)


def _set_joints(
    scene: MjSpec,
    robot: Robot,
    law: Law,
    friction: Friction,
) -> None:
    """Set damping, friction, armature and effort limits of the joints, and tie the followers."""
    still = np.zeros(robot.dof)
    rubs = still if friction.coulomb is None else friction.coulomb[0]
    damping = still if friction.viscous is None else friction.viscous[0]
    armature = law.column("armature")
    effort_range = law.effort_range.T
    for at, name in enumerate(robot.joint_names):
        joint = scene.joint(name)
        joint.armature = armature[at]
        joint.frictionloss = rubs[at]
        # Damping is a polynomial of the speed in MuJoCo.
        joint.damping = [damping[at], 0, 0]
        if robot.independent[at] and np.isfinite(effort_range[at]).any():
            joint.actfrclimited, joint.actfrcrange = True, np.clip(effort_range[at], -_FAR, _FAR)
    coupling = robot.coupling
    for follower in coupling.followers:
        # MuJoCo's polynomial of the leader's position; the higher coefficients are 0.
        tie = scene.add_equality(type=mujoco.mjtEq.mjEQ_JOINT)
        tie.objtype = mujoco.mjtObj.mjOBJ_JOINT
        tie.name1 = robot.joint_names[follower]
        tie.name2 = robot.joint_names[coupling.leader[follower]]
        figures = [coupling.offset[follower], coupling.multiplier[follower]]
        tie.data = np.pad(figures, (0, len(tie.data) - 2))


def _start(model: MjModel, robot: Robot, servos: bool) -> dict[str, str]:
    """Return the keyframe "home": the start pose as positions and setpoints."""
    qpos = model.qpos0.copy()
    if not robot.fixed_base:
        qpos[:7] = base_start(robot, robot.start, robot.has_ground)
    for at, name in enumerate(robot.joint_names):
        qpos[model.joint(name).qposadr] = robot.start[at]
    columns = {"qpos": qpos, "ctrl": robot.start[robot.independent] * servos}
    return {"name": "home"} | {
        key: _numbers_text(*row) for key, row in columns.items() if row.any()
    }


def _exact(scene: MjSpec) -> Any:
    """Return the XML of a compiled scene, with all digits of the dynamics, of which MuJoCo writes
    six.
    """
    root = etree.fromstring(scene.to_xml().encode())
    _write(root.find("option"), scene.option, timestep="timestep", gravity="gravity")
    for element in root.iterfind("worldbody//body"):
        body = scene.body(element.get("name"))
        _write(element, body, pos="pos", quat="quat")
        inertial = element.find("inertial")
        _write(
            inertial,
            body,
            pos="ipos",
            quat="iquat",
            mass="mass",
            diaginertia="inertia",
        )
    for element in root.iterfind("worldbody//joint[@name]"):
        joint = scene.joint(element.get("name"))
        if joint.actfrclimited == mujoco.mjtLimited.mjLIMITED_TRUE:
            # MuJoCo leaves out a range that is nearly 0, and then refuses to read the joint.
            element.set("actuatorfrcrange", "0 0")
        _write(
            element,
            joint,
            axis="axis",
            range="range",
            actuatorfrcrange="actfrcrange",
            armature="armature",
            damping="damping",
            frictionloss="frictionloss",
        )
    for element, tie in zip(root.findall("equality/joint"), scene.equalities, strict=True):
        _write(element, tie, polycoef="data")
    return root


def _write(element: Any, source: Any, **fields: str) -> None:
    """Replace the numbers of the attributes that an element has by those of the fields of
    ``source``.
    """
    for key, field in fields.items():
        if element is not None and key in element.attrib:
            # MuJoCo leaves out zeros at the end.
            count = len(element.get(key).split())
            element.set(key, _numbers_text(*np.atleast_1d(getattr(source, field))[:count]))
