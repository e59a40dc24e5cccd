"""MJCF of the simulated robot, with the law in MuJoCo's own PID actuators, or with its motors alone.

MuJoCo's ``pid`` actuator (3.15 and later), with the error e, inputs r, r' and ff, and the integral A::

    effort = min(max(kp e + ki A + kv (r' - q') + ff, low), high)
    A     <- A + dt e        while |A| < imax, or towards 0

That is this package's law with the measured velocity, output first, without anti-windup. Its output after a step was
compared with MuJoCo 4.0's. A motor alone is a ``general`` actuator, whose input u is the effort asked for::

    effort = min(max(s x + b, low), high)        x = u(t - d), or its first-order lag
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import mujoco
import numpy as np
from lxml import etree
from numpy.typing import ArrayLike

from batchpid.checks.validate import choice
from batchpid.errors import InvalidArgumentError, RobotError
from batchpid.export.exported import Exported
from batchpid.export.pd_drive import Drive
from batchpid.law.params import PIDParams, make_params
from batchpid.motors.actuators import Actuators
from batchpid.sim.engine.joint_friction import added_friction, own_friction
from batchpid.sim.engine.mujoco.model_builder import principal_inertia, robot_spec
from batchpid.sim.engine.mujoco.solver import SOLVERS
from batchpid.sim.engine.sapien.body_inertias import body_inertias
from batchpid.sim.engine.scene_spec import SceneSpec
from batchpid.sim.robot.description import RobotDescription
from batchpid.sim.robot.inertia import nearest_physical

LINEAR = 1
"""Interpolation between the samples of a delay."""
INPUTS = 7
"""Inputs of each actuator, in its order in ``ctrl``: position, velocity, feedforward (bits of ``mjtCtrlInput``)."""


def to_mjcf(
    robot: RobotDescription,
    params: PIDParams | None,
    dt: float,
    *,
    actuators: Actuators | None = None,
    inertia: ArrayLike | None = None,
    physics: str = "accurate",
) -> Exported:
    """Return the MJCF of ``robot``, one actuator for each independent joint, and its differences.

    Bodies are the rigid bodies that are simulated here, with repaired inertias, convex shapes, pairs that do not
    collide, joint limits, damping, Coulomb friction and armature; followers are tied to their leaders by constraints.
    Each ``pid`` actuator has three inputs in ``ctrl``: position, velocity and feedforward.

    Parameters
    ----------
    params
        Of one env: (1, joints), all joints. None: the motors alone; the input in ``ctrl`` is the effort asked for.
    dt
        Time step of the simulation, and so of the control [s].
    actuators
        Motors of one env. Written are armature, friction, effort limit and command delay, with ``pid`` as a delay of
        the inputs; of motors alone also strength, bias and lag.
    inertia
        As in :func:`batchpid.export.to_ros2_control`, of all joints.
    physics
        "accurate", "fast" or "free": settings of the solver.

    Raises
    ------
    InvalidArgumentError
        Params or actuators for several envs, gains per inertia without ``inertia``, or unknown physics.
    RobotError
        MuJoCo cannot build the robot.
    """
    law = make_params(robot.dof, 0.0, measurement_rate="measured") if params is None else params
    found = Drive(law, robot.joint_names, dt, inertia, actuators, integrates=True, two_sided=True)
    spec = SceneSpec(
        robot.urdf,
        robot.ignored_pairs,
        robot.joints,
        found.dt,
        SOLVERS[choice("physics", physics, SOLVERS)],
        dissipation=robot.dissipation,
        ground=robot.has_ground,
        fixed_base=robot.fixed_base,
        merge_fixed=robot.merge_fixed,
        engine="mujoco",
    )
    inertias = body_inertias(spec)
    scene, names = robot_spec(spec, inertias)
    scene.modelname, scene.option.disableflags = robot.name, 0
    for link, name in names.items():
        found += _set_inertia(scene.body(name), inertias[link], link)
    friction = added_friction(own_friction(spec), found.actuators)
    _set_joints(scene, robot, found, friction)
    _set_actuators(scene, robot, found, params is not None)
    try:
        scene.compile()
    except ValueError as error:
        raise RobotError(f"MuJoCo cannot build the robot: {error}; correct the URDF") from error
    _compare(found, robot, friction, params is not None)
    head = "".join(f"<!-- differs: {' '.join(each.split()).replace('--', '- -')} -->\n" for each in found)
    return Exported(f"{head}{_exact(scene)}", tuple(found))


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


def _set_joints(scene: Any, robot: RobotDescription, found: Drive, friction: Any) -> None:
    """Set damping, friction and armature of the joints, and tie the followers."""
    rows = {"damping": friction.viscous, "frictionloss": friction.coulomb}
    for at, name in enumerate(robot.joint_names):
        joint = scene.joint(name)
        joint.armature = found.motor("armature")[at]
        for field, leaf in rows.items():
            if leaf is not None:
                value = float(np.broadcast_to(leaf, (1, robot.dof))[0, at])
                setattr(joint, field, [value, 0, 0] if np.ndim(getattr(joint, field)) else value)
    if (coupling := robot.coupling) is None:
        return
    for follower in np.flatnonzero(~coupling.independent):
        tie = scene.add_equality(type=mujoco.mjtEq.mjEQ_JOINT)
        tie.objtype = mujoco.mjtObj.mjOBJ_JOINT
        tie.name1, tie.name2 = robot.joint_names[follower], robot.joint_names[coupling.leader[follower]]
        figures = [coupling.offset[follower], coupling.multiplier[follower]]
        tie.data = np.pad(figures, (0, len(tie.data) - 2))


def _set_actuators(scene: Any, robot: RobotDescription, found: Drive, controls: bool) -> None:
    kp, ki, kd, limit = found.value("kp"), found.value("ki"), found.value("kd"), found.integral_limit
    low, high = found.value("effort_min", -math.inf), found.value("effort_max", math.inf)
    motor, delay = found.motor("effort_limit", math.inf), found.motor("command_delay")
    strength, bias, lag = found.motor("strength", 1.0), found.motor("bias"), found.motor("lag")
    low, high = np.maximum(low, -motor), np.minimum(high, motor)
    for at in np.flatnonzero(robot.independent):
        name = robot.joint_names[at]
        actuator = scene.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        if controls:
            integrates = ki[at] > 0 and limit[at] > 0
            imax = limit[at] / ki[at] if integrates and math.isfinite(limit[at]) else -1.0
            actuator.set_to_pid(kp=kp[at], kv=kd[at], ki=ki[at] if integrates else 0.0, imax=imax, ctrlspec=INPUTS)
        else:
            actuator.gainprm[0], actuator.biasprm[0] = strength[at], bias[at]
            actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
            if lag[at]:
                actuator.dyntype, actuator.dynprm[0] = mujoco.mjtDyn.mjDYN_FILTEREXACT, lag[at]
                actuator.actearly = True
        if delay[at]:
            actuator.delay, actuator.interp = delay[at], LINEAR
            actuator.nsample = math.ceil(delay[at] / found.dt) + 2
        if math.isfinite(low[at]) or math.isfinite(high[at]):
            if low[at] >= high[at]:
                problem = "must be below effort_max for MuJoCo"
                raise InvalidArgumentError("effort_min", problem, joint=name, value=low[at], remedy="widen the limits")
            actuator.forcelimited = True
            actuator.forcerange = np.clip([low[at], high[at]], -1e10, 1e10)


def _compare(found: Drive, robot: RobotDescription, friction: Any, controls: bool) -> None:
    """Add the differences of MuJoCo's PID, friction and constraints."""
    if controls:
        found.compare_integral(first=False)
        found.delays_setpoint()
    has = {"armature", "viscous", "coulomb", "command_delay", *(() if controls else ("strength", "bias", "lag"))}
    found.lack_motors(has)
    if not controls and (both := (found.motor("lag") > 0) & np.isfinite(found.motor("effort_limit", math.inf))).any():
        found.append(f"lag: before effort_limit, not after it: {found.listed(found.motor('lag'), both)} s")
    if friction.coulomb is not None and np.any(friction.coulomb):
        found.append("friction: a soft constraint in MuJoCo, in which a joint creeps below its friction")
    if robot.coupling is not None:
        names = [name for name, own in zip(robot.joint_names, robot.independent, strict=True) if not own]
        found.append(f"followers: soft constraints in MuJoCo: {', '.join(names)}")


def _exact(scene: Any) -> str:
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
        fields = ("axis", "range", "armature", "damping", "frictionloss")
        _write(element, {field: getattr(joint, field) for field in fields})
    for element in root.iterfind("actuator/*"):
        actuator = scene.actuator(element.get("name"))
        _write(
            element,
            {field: getattr(actuator, field) for field in ("gainprm", "biasprm", "dynprm", "forcerange", "delay")},
        )
    for element, given in zip(root.findall("equality/joint"), scene.equalities, strict=True):
        _write(element, {"polycoef": given.data})
    for element in root.iterfind("asset/mesh"):
        _write(element, {"vertex": scene.mesh(element.get("name")).uservert})
    etree.indent(root)
    return etree.tostring(root, encoding="unicode") + "\n"


def _write(element: Any, figures: dict[str, Any]) -> None:
    """Replace the numbers of the attributes that an element has."""
    for key, values in figures.items():
        if element is not None and key in element.attrib:
            numbers = np.atleast_1d(values)[: len(element.get(key).split())]
            element.set(key, " ".join(repr(float(each)) for each in numbers))
