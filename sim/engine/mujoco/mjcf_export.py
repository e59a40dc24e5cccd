"""MJCF of the simulated robot, with the law or its motors in MuJoCo's own actuators.

The equations are in :mod:`batchpid.sim.engine.mujoco.mjcf_actuators`. ``<pid>`` is this package's law with the measured
velocity and ``integration="output_first"``, without anti-windup.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import mujoco
import numpy as np
from lxml import etree
from numpy.typing import ArrayLike

from batchpid.arrays.array_types import Document, MjModel, MjSpec
from batchpid.checks.validate import choice
from batchpid.errors import InvalidArgumentError, RobotError
from batchpid.export.differences import Exported
from batchpid.export.pd_drive import Drive
from batchpid.law.params import PIDParams, make_params
from batchpid.motors.actuators import Actuators
from batchpid.motors.guard import Guard, check_guard
from batchpid.sim.engine.mujoco.mjcf_actuators import FAR, MjcfActuators
from batchpid.sim.engine.mujoco.model_builder import principal_inertia, robot_spec
from batchpid.sim.engine.physics import SOLVERS
from batchpid.sim.engine.robot_model import base_start
from batchpid.sim.engine.scene_spec import SceneSpec, added_friction, own_friction
from batchpid.sim.robot.description import RobotDescription
from batchpid.sim.robot.link_repair import nearest_physical
from batchpid.sim.robot.simulated_links import body_inertias


def to_mjcf(
    robot: RobotDescription,
    params: PIDParams | None,
    dt: float,
    *,
    actuators: Actuators | None = None,
    guard: Guard | None = None,
    inertia: ArrayLike | None = None,
    physics: str = "accurate",
) -> Exported:
    """Return the MJCF of ``robot``, one actuator for each independent joint, and its differences.

    Bodies are the rigid bodies that are simulated here, with repaired inertias, convex shapes, pairs that do not
    collide, joint limits, damping, Coulomb friction and armature; followers are tied to their leaders by constraints.
    Each actuator of the law has three inputs in ``ctrl``: position, velocity and feedforward. The keyframe "home" has
    the start pose as joint positions, position inputs and rate-limited setpoints, and lags at the holding efforts.

    Parameters
    ----------
    params
        Of one env: (1, joints), all joints. None: the motors alone; the input in ``ctrl`` is the effort asked for.
    dt
        Time step of the simulation, and so of the control [s].
    actuators
        Motors of one env. Their armature, friction, effort limit, torque-speed line, lag and command delay are written;
        with the law the delay acts on the inputs. Strength and bias are written for motors alone.
    guard
        Limits of the law's setpoints, for one env. Those of position and rate are written.
    inertia
        As in :func:`batchpid.export.to_ros2_control`, of all joints.
    physics
        "accurate", "fast" or "free": settings of the solver.

    Raises
    ------
    InvalidArgumentError
        Params, actuators or guard for several envs, gains per mass matrix without ``inertia``, a guard without params,
        or unknown physics.
    RobotError
        MuJoCo cannot build the robot.
    """
    law = make_params(robot.dof, 0.0, measurement_rate="measured") if params is None else params
    if guard is not None:
        check_guard(guard, 1, robot.joint_names)
        if params is None:
            raise InvalidArgumentError("guard", "limits setpoints of a law", remedy="pass params, or leave it out")
    found = Drive(law, robot.joint_names, dt, inertia, actuators)
    spec = SceneSpec(
        robot.urdf,
        robot.ignored_pairs,
        robot.joints,
        found.dt,
        SOLVERS[choice("physics", physics, SOLVERS)],
        dissipation=robot.dissipation,
        ground=robot.has_ground,
        fixed_base=robot.fixed_base,
        engine="mujoco",
    )
    # The bodies are those that the engine simulates; inertias and efforts are then written with all their digits.
    inertias = body_inertias(spec.urdf, spec.separate)
    scene, names = robot_spec(spec, inertias)
    scene.modelname, scene.option.disableflags = robot.name, 0
    for link, name in names.items():
        found += _set_inertia(scene.body(name), inertias[link], link)
    friction = added_friction(own_friction(spec), found.actuators)
    _set_joints(scene, robot, found, friction)
    motors = MjcfActuators(found, robot.independent, params is not None, guard, robot.continuous)
    for at in np.flatnonzero(np.isfinite(motors.effort_range).any(1)):
        joint = scene.joint(robot.joint_names[at])
        joint.actfrclimited, joint.actfrcrange = True, np.clip(motors.effort_range[at], -FAR, FAR)
    # Compiled twice: once to find what the robot lacks, and again with the actuators, whose keyframe needs their sizes.
    try:
        scene.compile()
        root = _exact(scene)
        _add_actuators(root, motors)
        etree.indent(root)
        model = mujoco.MjModel.from_xml_string(etree.tostring(root, encoding="unicode"))
    except ValueError as error:
        raise RobotError(f"MuJoCo cannot build the robot: {error}; correct the URDF") from error
    _add_keyframe(root, model, robot, motors)
    etree.indent(root)
    _compare(found, robot, friction)
    head = "".join(f"<!-- differs: {' '.join(each.split()).replace('--', '- -')} -->\n" for each in found)
    return Exported(f"{head}{etree.tostring(root, encoding='unicode')}\n", tuple(found))


def _set_inertia(body: Any, inertia: Any, link: str) -> Iterable[str]:
    """Set the inertia of a body; yield the change of a tensor that no body has, which MuJoCo refuses."""
    given = inertia.tensor
    low, middle, high = np.linalg.eigvalsh(given)
    possible = low > 0 and low + middle >= high
    used = given if possible else nearest_physical(given * (1 + 1e-9))
    moments, wxyz = principal_inertia(inertia._replace(tensor=used))
    body.inertia, body.iquat = moments, wxyz
    if not possible:
        figures = [" ".join(f"{each:.4g}" for each in np.linalg.eigvalsh(tensor)) for tensor in (given, used)]
        yield f"inertia: link {link!r}: MuJoCo needs moments of a body: {figures[1]} instead of {figures[0]} kg m^2"


def _set_joints(scene: MjSpec, robot: RobotDescription, found: Drive, friction: Any) -> None:
    """Set damping, friction and armature of the joints, and tie the followers."""
    rows = {"damping": friction.viscous, "frictionloss": friction.coulomb}
    for at, name in enumerate(robot.joint_names):
        joint = scene.joint(name)
        joint.armature = found.motor("armature")[at]
        for field, leaf in rows.items():
            if leaf is not None:
                value = float(np.broadcast_to(leaf, (1, robot.dof))[0, at])
                setattr(joint, field, [value, 0, 0] if np.ndim(getattr(joint, field)) else value)
    coupling = robot.coupling
    for follower in coupling.followers:
        tie = scene.add_equality(type=mujoco.mjtEq.mjEQ_JOINT)
        tie.objtype = mujoco.mjtObj.mjOBJ_JOINT
        tie.name1, tie.name2 = robot.joint_names[follower], robot.joint_names[coupling.leader[follower]]
        figures = [coupling.offset[follower], coupling.multiplier[follower]]
        tie.data = np.pad(figures, (0, len(tie.data) - 2))


def _add_actuators(root: Any, motors: MjcfActuators) -> None:
    """Add the actuators to the XML."""
    section = etree.SubElement(root, "actuator")
    for tag, attributes in motors.elements:
        etree.SubElement(section, tag, attributes)


def _add_keyframe(root: Any, model: MjModel, robot: RobotDescription, motors: MjcfActuators) -> None:
    """Add the keyframe "home": the start pose as positions and setpoints, and lags at the holding efforts."""
    data = mujoco.MjData(model)
    if not robot.fixed_base:
        data.qpos[:7] = base_start(robot, robot.start, robot.has_ground)
    for at, name in enumerate(robot.joint_names):
        data.qpos[model.joint(name).qposadr] = robot.start[at]
    mujoco.mj_forward(model, data)
    holding = np.array([[data.qfrc_bias[model.joint(name).dofadr[0]] for name in robot.joint_names]])
    holding = robot.coupling.efforts(holding)
    ctrl, act = np.zeros(model.nu), np.zeros(model.na)
    for actuator in range(model.nactuator):
        at = robot.joint_names.index(model.actuator(actuator).name)
        first, count = model.actuator_actadr[actuator], model.actuator_actnum[actuator]
        if motors.controls:
            ctrl[model.actuator_ctrladr[actuator]] = robot.start[at]
        if motors.has_rate[at]:  # the setpoint is the first of the states
            act[first] = robot.start[at]
        if motors.has_lag[at]:  # the current, or the filtered input, is the last
            constant = model.actuator_gainprm[actuator, 1] if motors.is_dcmotor[at] else 1.0
            act[first + count - 1] = holding[0, at] / constant
    columns = {"qpos": data.qpos, "ctrl": ctrl, "act": act}
    figures = {key: " ".join(repr(float(each)) for each in row) for key, row in columns.items() if row.any()}
    etree.SubElement(etree.SubElement(root, "keyframe"), "key", {"name": "home", **figures})


def _compare(found: Drive, robot: RobotDescription, friction: Any) -> None:
    """Add the differences of MuJoCo's friction and constraints, and from an MJCF file that the robot is from."""
    if robot.mjcf is not None:
        found.append("scene: the robot alone, without objects, tendons, springs and equalities of its MJCF file")
    if friction.coulomb is not None and np.any(friction.coulomb):
        found.append("friction: a soft constraint in MuJoCo, in which a joint creeps below its friction")
    if names := [robot.joint_names[joint] for joint in robot.coupling.followers]:
        found.append(f"followers: soft constraints in MuJoCo: {', '.join(names)}")


def _exact(scene: MjSpec) -> Any:
    """Return the XML of a compiled scene with all digits, of which MuJoCo writes six."""
    root = etree.fromstring(scene.to_xml().encode())
    _write(root.find("option"), {"timestep": scene.option.timestep, "gravity": scene.option.gravity})
    for element in root.iterfind("worldbody//body"):
        body = scene.body(element.get("name"))
        _write(element, {"pos": body.pos, "quat": body.quat})
        figures = {"pos": body.ipos, "quat": body.iquat, "mass": body.mass, "diaginertia": body.inertia}
        _write(element.find("inertial"), figures)
        for geom, given in zip(element.findall("geom"), body.geoms, strict=True):
            _write(geom, {"size": given.size, "pos": given.pos, "quat": given.quat})
    for element in root.iterfind("worldbody//joint[@name]"):
        joint = scene.joint(element.get("name"))
        fields = ("axis", "range", "actuatorfrcrange", "armature", "damping", "frictionloss")
        _write(element, {field: getattr(joint, field.replace("actuatorfrc", "actfrc")) for field in fields})
    for element, given in zip(root.findall("equality/joint"), scene.equalities, strict=True):
        _write(element, {"polycoef": given.data})
    for element in root.iterfind("asset/mesh"):
        _write(element, {"vertex": scene.mesh(element.get("name")).uservert})
    return root


def _write(element: Any, figures: Document) -> None:
    """Replace the numbers of the attributes that an element has."""
    for key, values in figures.items():
        if element is not None and key in element.attrib:
            numbers = np.atleast_1d(values)[: len(element.get(key).split())]
            element.set(key, " ".join(repr(float(each)) for each in numbers))
