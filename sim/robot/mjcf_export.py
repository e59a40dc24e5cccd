"""MJCF of the simulated robot, with the law or its motors in MuJoCo's own actuators.

Each independent joint has one actuator: MuJoCo's PID, its DC motor, or a plain motor.

``<pid>`` (MuJoCo 3.12 and later), with position q, inputs r, r' and ff, setpoint g and integral A::

    c       = min(max(r, posrange_0), posrange_1)
    g       = min(max(c, g - dt slewmax), g + dt slewmax)
    effort  = kp (g - q) + ki A + kv (r' - q') + ff
    A      <- A + dt (g - q)        while |A| < imax, or towards 0

``<dcmotor>`` has the same effort u, without posrange, and clamps the integral: min(max(A, -Imax),
Imax). Its supply voltage is 1 V here. The stall effort S and the no-load speed v0 give the
torque-speed line, and the time constant T of the winding gives the lag::

    i       = min(max(u, S (-1 - q'/v0)), S (1 - q'/v0))
    effort <- effort + (1 - exp(-dt/T)) (i - effort)

A plain motor is a ``<general>`` actuator, where x is the delayed input u(t - delay), or that after
a first-order lag::

    effort  = gainprm x + biasprm

Limits of the effort are the joints' (``actuatorfrcrange``): each joint has one actuator. (MuJoCo's
documentation: XML reference, actuator; "DC Motor Model". All were compared with MuJoCo 4.0 step by
step.)

``<pid>`` is this package's law with the measured velocity and ``integration="output_first"``, without
anti-windup.
"""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np
from lxml import etree
from numpy.typing import ArrayLike

from batchpid.arrays.array_types import Bool, Float64, MjModel, MjSpec
from batchpid.errors import InvalidArgumentError, RobotError
from batchpid.export.differences import Exported, Law, differences, export_law
from batchpid.law.params import PIDParams, make_params
from batchpid.motors.actuators import Actuators
from batchpid.motors.friction import Friction
from batchpid.motors.guard import Guard
from batchpid.sim.engine.mujoco.model_builder import principal_inertia, robot_spec
from batchpid.sim.engine.scene_spec import SOLVERS, added_friction, own_friction
from batchpid.sim.geometry.shapes import nearest_physical
from batchpid.sim.robot.robot import Robot
from batchpid.sim.robot.robot_model import base_start
from batchpid.sim.robot.robot_options import scene_of
from batchpid.task_space.frames import SpatialInertia

_FAR = 1e10
"""Finite limit in place of an infinite one."""
_INPUTS = {"input": "pos vel ff"}


class _Actuators:
    """Actuators of the ``driven`` joints (a mask), of a law or of its motors alone.

    Attributes
    ----------
    elements
        (tag, attributes) of each actuator.
    has_rate
        Mask (joints,) of the joints with a rate-limited setpoint.
    """

    def __init__(self, law: Law, driven: Bool) -> None:
        self._law = law
        self._rate = law.column("rate")
        self._is_dcmotor = law.is_dcmotor
        self.has_rate = driven & np.isfinite(self._rate)
        self.elements = [self._element(int(joint)) for joint in np.flatnonzero(driven)]

    def _element(self, joint: int) -> tuple[str, dict[str, str]]:
        law = self._law
        name = law.joints[joint]
        low, high = law.effort_range[:, joint].tolist()
        if low >= high:
            problem = "must be below effort_max for MuJoCo"
            raise InvalidArgumentError(
                "effort_min",
                problem,
                joint=name,
                value=low,
                remedy="widen the limits",
            )
        element = {"name": name, "joint": name}
        if delay := law.column("command_delay")[joint]:
            # MuJoCo interpolates between samples of the inputs: one more at either end.
            samples = math.ceil(delay / law.dt) + 2
            element |= {"delay": _numbers_text(delay), "nsample": str(samples), "interp": "linear"}
        if self._is_dcmotor[joint]:
            return "dcmotor", element | self._dcmotor(joint)
        if law.is_law:
            return "pid", element | self._pid(joint)
        element |= {
            "gainprm": _numbers_text(law.column("strength")[joint]),
            "biastype": "affine",
            "biasprm": _numbers_text(law.column("bias")[joint]),
        }
        if lag := law.column("lag")[joint]:
            element |= {"dyntype": "filterexact", "dynprm": _numbers_text(lag), "actearly": "true"}
        return "general", element

    def _gains(self, joint: int) -> dict[str, float]:
        """Return gains, and limits of the setpoint's rate and of the integral of the error; 0 for
        none.
        """
        kp, ki, kd, low, high = (
            float(self._law.column(option)[joint])
            for option in ("kp", "ki", "kd", "integral_min", "integral_max")
        )
        # MuJoCo limits the integral of the error, not its effort, symmetrically, and takes a limit
        # of 0 for none.
        limit = max(min(-low, high), 0.0)
        ki = ki if limit > 0 else 0.0
        imax = limit / ki if ki and math.isfinite(limit) else 0.0
        rate = float(self._rate[joint])
        slewmax = rate if math.isfinite(rate) else 0.0
        return {
            "kp": kp,
            "ki": ki,
            "kv": kd,
            "slewmax": slewmax,
            "imax": imax,
        }

    def _pid(self, joint: int) -> dict[str, str]:
        element = {
            key: _numbers_text(value)
            for key, value in self._gains(joint).items()
            if value or key == "kp"
        } | _INPUTS
        lower = self._law.column("lower")[joint]
        # MuJoCo needs a range of some width, also of a joint that is locked.
        ends = lower, max(self._law.column("upper")[joint], np.nextafter(lower, math.inf))
        if np.isfinite(ends).any():
            element["posrange"] = _numbers_text(*np.clip(ends, -_FAR, _FAR))
        return element

    def _dcmotor(self, joint: int) -> dict[str, str]:
        law = self._law
        # The gear, by which the motor's efforts are divided: the strength of motors alone.
        arm = 1.0 if law.is_law else float(law.column("strength")[joint])
        element = {"motorconst": "1 1", "resistance": "1"}
        voltage = 0.0
        if law.has_line[joint]:
            voltage = 1.0
            stall = law.column("saturation_effort")[joint] / arm
            speed = law.column("no_load_speed")[joint] * arm
            element = {"nominal": _numbers_text(voltage, stall, speed)}
        gains = self._gains(joint).values() if law.is_law else [0.0] * 5
        element |= _INPUTS if law.is_law else {"input": "ff", "gear": _numbers_text(arm)}
        element["controller"] = _numbers_text(*gains, voltage)
        if lag := law.column("lag")[joint]:
            element["inductance"] = _numbers_text(0, lag)
        return element


def _numbers_text(*numbers: Float64 | float) -> str:
    """Return numbers with all digits."""
    return " ".join(repr(float(number)) for number in numbers)


def to_mjcf(
    robot: Robot,
    params: PIDParams | None,
    dt: float,
    *,
    actuators: Actuators | None = None,
    guard: Guard | None = None,
    inertia: ArrayLike | None = None,
) -> Exported:
    """Return the MJCF of ``robot``, one actuator for each independent joint, and its differences.

    Bodies are the rigid bodies that are simulated here, with repaired inertias, convex shapes,
    pairs that do not collide, joint limits, damping, Coulomb friction and armature; followers are
    tied to their leaders by constraints. Each actuator of the law has three inputs in ``ctrl``:
    position, velocity and feedforward. The keyframe "home" has the start pose as positions of base
    and joints, position inputs and rate-limited setpoints.

    Parameters
    ----------
    params
        Of one env: (1, joints), all joints. None: the motors alone; the input in ``ctrl`` is the
        effort asked for.
    dt
        Time step of the simulation, and so of the control [s].
    actuators
        Motors of one env. Their armature, friction, effort limit, torque-speed line, lag and
        command delay are written; with the law the delay acts on the inputs. Strength and bias are
        written for motors alone.
    guard
        Limits of the law's setpoints, for one env. Those of position and rate are written.
    inertia
        As in :func:`batchpid.export.to_ros2_control`, of all joints.

    Raises
    ------
    InvalidArgumentError
        Params, actuators or guard for several envs, gains per mass matrix without ``inertia``, or a
        guard without params.
    RobotError
        MuJoCo cannot build the robot.
    """
    has_law = params is not None
    if guard is not None:
        guard.check(1, robot.joint_names)
        if not has_law:
            raise InvalidArgumentError(
                "guard",
                "needs a law, whose setpoints it limits",
                remedy="pass params, or leave it out",
            )
    if params is None:
        params = make_params(robot.dof, 0.0, measurement_rate="measured")
    law = export_law(
        params,
        robot.joint_names,
        dt,
        inertia,
        actuators,
        guard,
        has_law,
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
    motors = _Actuators(law, robot.independent)
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
        for tag, attributes in motors.elements:
            etree.SubElement(section, tag, attributes)
        model = mujoco.MjModel.from_xml_string(etree.tostring(root, encoding="unicode"))
    except ValueError as error:
        raise RobotError(f"MuJoCo cannot build the robot: {error}; correct the URDF") from error
    # The model gives the sizes and places of the keyframe's rows.
    etree.SubElement(
        etree.SubElement(root, "keyframe"), "key", _start(model, robot, has_law, motors.has_rate)
    )
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


def _start(
    model: MjModel,
    robot: Robot,
    has_law: bool,
    has_rate: Bool,
) -> dict[str, str]:
    """Return the keyframe "home": the start pose as positions and setpoints."""
    qpos = model.qpos0.copy()
    ctrl = np.zeros(model.nu)
    act = np.zeros(model.na)
    if not robot.fixed_base:
        qpos[:7] = base_start(robot, robot.start, robot.has_ground)
    for at, name in enumerate(robot.joint_names):
        qpos[model.joint(name).qposadr] = robot.start[at]
    for actuator, joint in enumerate(np.flatnonzero(robot.independent)):
        if has_law:
            ctrl[model.actuator_ctrladr[actuator]] = robot.start[joint]
        if has_rate[joint]:  # the setpoint is the first of the states
            act[model.actuator_actadr[actuator]] = robot.start[joint]
    columns = {"qpos": qpos, "ctrl": ctrl, "act": act}
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
        )
        _write(
            element,
            joint,
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
