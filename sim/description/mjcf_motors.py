"""Actuators and coupled joints of a compiled MJCF file, as effort limits, armature, gains and mimic
joints.

An actuator with force F and moment arm g on a joint (the gear, times the joint's coefficient in a
fixed tendon) applies the effort g F; a follower q' = m q adds m g' to the arm on its leader. A
servo F = k u - kp g q - kv g q' has the gains g^2 kp and g^2 kv of a PID whose setpoint is its
target in units of the joint. (MuJoCo's documentation, "Computation", actuation model.)

Motors and servos of one joint are read. A finding names every other actuator.
"""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import mujoco
import numpy as np

from batchpid.arrays.array_types import MjModel
from batchpid.sim.description.mjcf_bodies import RobotInFile, label
from batchpid.sim.findings import Finding

Couplings = dict[str, tuple[str, float, float]]
"""Leader, multiplier and offset of each follower, as in ``<mimic>``."""
_TRN, _EQ = mujoco.mjtTrn, mujoco.mjtEq
_GAIN, _BIAS, _DYN = mujoco.mjtGain, mujoco.mjtBias, mujoco.mjtDyn
_FILTERS = (_DYN.mjDYN_NONE, _DYN.mjDYN_FILTER, _DYN.mjDYN_FILTEREXACT)
"""Dynamics whose state follows the control, so that the control's range limits the force."""
_OF_TENDONS = (
    "stiffness",
    "stiffnesspoly",
    "damping",
    "dampingpoly",
    "frictionloss",
    "armature",
    "limited",
)
"""Effects of a tendon by itself."""


class Servo(NamedTuple):
    """Law of an actuator, in units of its transmission. Without gains it is a motor."""

    kp: float = 0.0
    kv: float = 0.0
    input_gain: float = 1.0
    """Setpoint per unit of the control."""


@dataclass(frozen=True)
class JointMotors:
    """Motors of the joints by name, in N m or N; joints without an entry have none, or no limit."""

    effort_limit: dict[str, float] = field(default_factory=dict)
    """Infinite where the file gives none."""
    unmoved: set[str] = field(default_factory=set)
    """Joints that no actuator moves, in a file with actuators."""
    armature: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    """Reflected inertia [kg m^2 or kg]; a follower's armature is added to its leader's."""
    kp: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    kd: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    """Gains of servos."""
    setpoints: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Range of the setpoints of a servo."""


def read_couplings(robot: RobotInFile) -> Couplings:
    """Return the joints that linear equalities couple: y - y0 = c0 + c1 (x - x0), with y0, x0 the
    reference pose.
    """
    model = robot.model
    couplings: Couplings = {}
    for equality in np.flatnonzero(model.eq_active0).tolist():
        follower = int(model.eq_obj1id[equality])
        leader = int(model.eq_obj2id[equality])
        if model.eq_type[equality] != _EQ.mjEQ_JOINT or follower not in robot.joints:
            robot.lost["equality constraints"].append(label(model.equality(equality)))
            continue
        name = robot.joints[follower]
        offset, multiplier, *higher = model.eq_data[equality, :5].tolist()
        is_linear = leader in robot.joints and multiplier and not any(higher)
        if not is_linear or name in couplings:
            robot.lost["equalities that are not linear in one other joint"].append(repr(name))
            continue
        rest, rest_of_leader = model.qpos0[model.jnt_qposadr[[follower, leader]]].tolist()
        offset += rest - multiplier * rest_of_leader
        couplings[name] = robot.joints[leader], multiplier, offset
    return couplings


def read_motors(robot: RobotInFile, couplings: Couplings) -> JointMotors:
    """Return the motors of the joints, with findings for effects that are not simulated."""
    model = robot.model
    motors = JointMotors()
    findings = robot.repairs
    # A follower has no motor: its leader moves its armature, too.
    for joint, name in robot.joints.items():
        for leader, arm in _on_leaders({name: 1.0}, couplings).items():
            motors.armature[leader] += arm**2 * float(model.dof_armature[model.jnt_dofadr[joint]])
    # nu counts inputs, of which some actuators have several.
    for actuator in range(len(model.actuator_trntype)):
        arms = _on_leaders(_arms(model, actuator, robot), couplings)
        servo = _servo(model, actuator) if len(arms) == 1 else Servo()
        if len(arms) != 1 or not _is_plain(model, actuator):
            text = f"actuator {label(model.actuator(actuator))} has effects that are not simulated"
            text += ": only motors and servos of one joint are"
            remedy = "check gains and limits of the joint"
            findings += [Finding("actuator", text, remedy, name) for name in arms or [None]]
        for name, arm in arms.items():
            _add_limits(
                model,
                actuator,
                name,
                arm,
                motors,
                findings,
            )
            motors.kp[name] += arm**2 * servo.kp
            motors.kd[name] += arm**2 * servo.kv
        if servo.kp:
            _add_setpoints(model, actuator, servo, robot, motors)
    for joint, name in robot.joints.items():
        if model.nu and name not in motors.effort_limit and name not in couplings:
            text = (
                "no actuator of the file moves the joint: it is controlled like all others, without"
                " compensation of gravity and friction"
            )
            remedy = "give it gains of 0 to let it move freely, or pass free_joints=[] to a runner"
            motors.unmoved.add(name)
            findings.append(Finding("actuator", text, remedy, name))
        # A limit of 0 counts as none.
        limit = motors.effort_limit.get(name, math.inf) or math.inf
        if model.jnt_actfrclimited[joint]:
            limit = min(limit, _magnitude(model.jnt_actfrcrange[joint], name, findings))
        motors.effort_limit[name] = limit
    robot.lost["effects of tendons"] += [
        label(model.tendon(tendon))
        for tendon in range(model.ntendon)
        if any(np.any(getattr(model, f"tendon_{effect}")[tendon]) for effect in _OF_TENDONS)
    ]
    return motors


def _is_plain(model: MjModel, actuator: int) -> bool:
    """Return whether an actuator is a motor or a servo without further effects."""
    effects = ("delay", "damping", "dampingpoly")
    if model.actuator_plugin[actuator] >= 0:
        return False
    if any(np.any(getattr(model, f"actuator_{effect}")[actuator]) for effect in effects):
        return False
    # The file may switch off the actuators of a group.
    group = int(model.actuator_group[actuator])
    if 0 <= group <= 30 and model.opt.disableactuator & (1 << group):
        return False
    is_fixed = model.actuator_gaintype[actuator] == _GAIN.mjGAIN_FIXED
    is_direct = model.actuator_dyntype[actuator] == _DYN.mjDYN_NONE
    if not is_fixed or not is_direct or model.actuator_gainprm[actuator, 0] == 0:
        return False
    bias = model.actuator_biastype[actuator]
    constant, stiffness, damping = model.actuator_biasprm[actuator, :3].tolist()
    is_law = bias == _BIAS.mjBIAS_AFFINE and constant == 0 and damping <= 0
    # A damping alone is a servo of velocities.
    is_law = is_law and (stiffness < 0 or (stiffness == damping == 0))
    return bool(bias == _BIAS.mjBIAS_NONE or is_law)


def _servo(model: MjModel, actuator: int) -> Servo:
    """Return the law of an actuator; that of a motor for unknown laws."""
    # A plugin's parameters have other meanings.
    is_affine = model.actuator_biastype[actuator] == _BIAS.mjBIAS_AFFINE
    if model.actuator_plugin[actuator] >= 0 or not is_affine:
        return Servo()
    kp, kv = np.maximum(-model.actuator_biasprm[actuator, 1:3], 0.0).tolist()
    if model.actuator_gaintype[actuator] == _GAIN.mjGAIN_FIXED and kp:
        return Servo(kp, kv, float(model.actuator_gainprm[actuator, 0]) / kp)
    return Servo(kp, kv)


def _add_setpoints(
    model: MjModel,
    actuator: int,
    servo: Servo,
    robot: RobotInFile,
    motors: JointMotors,
) -> None:
    """Add the range of a servo's setpoints, where its transmission moves with one joint alone."""
    arms = _arms(model, actuator, robot)
    control = int(model.actuator_ctrladr[actuator])
    if len(arms) == 1 and model.actuator_ctrllimited[control]:
        ((name, arm),) = arms.items()
        ends = servo.input_gain * model.actuator_ctrlrange[control] / arm
        motors.setpoints[name] = float(ends.min()), float(ends.max())


def _add_limits(
    model: MjModel,
    actuator: int,
    name: str,
    arm: float,
    motors: JointMotors,
    findings: list[Finding],
) -> None:
    """Add armature and effort limit of an actuator to a joint."""
    motors.armature[name] += arm**2 * float(np.ravel(model.actuator_armature[actuator])[0])
    low, high = -math.inf, math.inf
    if model.actuator_forcelimited[actuator]:
        low, high = model.actuator_forcerange[actuator].tolist()
    # The range of a servo's control is one of positions, not of forces.
    control = int(model.actuator_ctrladr[actuator])
    is_fixed = model.actuator_gaintype[actuator] == _GAIN.mjGAIN_FIXED
    is_force = is_fixed and int(model.actuator_dyntype[actuator]) in _FILTERS
    is_motor = not any(_servo(model, actuator)[:2])
    if is_motor and is_force and model.actuator_ctrllimited[control]:
        forces = float(model.actuator_gainprm[actuator, 0]) * model.actuator_ctrlrange[control]
        low = max(low, float(forces.min()))
        high = min(high, float(forces.max()))
    force = _magnitude((low, high), name, findings)
    tendon = int(model.actuator_trnid[actuator, 0])
    if model.actuator_trntype[actuator] == _TRN.mjTRN_TENDON and model.tendon_actfrclimited[tendon]:
        force = min(force, _magnitude(model.tendon_actfrcrange[tendon], name, findings))
    motors.effort_limit[name] = motors.effort_limit.get(name, 0.0) + abs(arm) * force


def _arms(model: MjModel, actuator: int, robot: RobotInFile) -> dict[str, float]:
    """Return the moment arms of an actuator on the joints that it acts on by a constant arm, by
    name; none if it acts otherwise.
    """
    kind = int(model.actuator_trntype[actuator])
    target = int(model.actuator_trnid[actuator, 0])
    # An orientation servo has several outputs, each with a gear.
    gear = float(model.actuator_gear[int(model.actuator_outadr[actuator]), 0])
    if kind in (_TRN.mjTRN_JOINT, _TRN.mjTRN_JOINTINPARENT) and target in robot.joints:
        return {robot.joints[target]: gear}
    if kind != _TRN.mjTRN_TENDON:
        return {}
    arms: dict[str, float] = defaultdict(float)
    first = int(model.tendon_adr[target])
    for wrap in range(first, first + int(model.tendon_num[target])):
        joint = int(model.wrap_objid[wrap])
        if model.wrap_type[wrap] != mujoco.mjtWrap.mjWRAP_JOINT or joint not in robot.joints:
            return {}
        arms[robot.joints[joint]] += gear * float(model.wrap_prm[wrap])
    return dict(arms)


def _on_leaders(arms: dict[str, float], couplings: Couplings) -> dict[str, float]:
    """Return the moment arms on the independent joints, with those on their followers."""
    sums: dict[str, float] = defaultdict(float)
    for name, arm in arms.items():
        for _ in couplings:  # at most as many leaders of leaders
            if name in couplings:
                name, multiplier, _offset = couplings[name]
                arm = arm * multiplier
        sums[name] += arm
    return {name: arm for name, arm in sums.items() if arm}


def _magnitude(ends: Any, name: str, findings: list[Finding]) -> float:
    """Return the magnitude of a symmetric range, else the smaller one that is not zero, with a
    finding.
    """
    # Limits here are symmetric; the smaller is safe in both directions.
    smaller, larger = sorted(abs(float(end)) for end in ends)
    if smaller != larger:
        text = "effort limits differ by direction: the smaller one above zero is used in both"
        detail = f"{min(ends):g} to {max(ends):g}"
        remedy = "pass effort_min= and effort_max= to robot.params()"
        findings.append(Finding("limits", text, remedy, name, detail=detail))
    return smaller or larger
