"""Actuators and coupled joints of a compiled MJCF file, as effort limits, armature, gains, motors
and mimic joints.

An actuator with force F and moment arm g on a joint (the gear, times the joint's coefficient in a
fixed tendon) applies the effort g F; a follower q' = m q adds m g' to the arm on its leader. A
servo F = k u - kp g q - kv g q' has the gains g^2 kp and g^2 kv of a PID whose setpoint is its
target in units of the joint. (MuJoCo's documentation, "Computation", actuation model.) MuJoCo's PID
and its DC motor have the laws that :mod:`batchpid.sim.robot.mjcf_export` describes.

Motors, servos, PIDs and DC motors of one joint are read. A finding names every other actuator.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
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
_INPUT = mujoco.mjtCtrlInput
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


class ActuatorLaw(NamedTuple):
    """Law and motor of an actuator, in units of its transmission. Without gains it is a motor."""

    kp: float = 0.0
    ki: float = 0.0
    kv: float = 0.0
    error_limit: float = 0.0
    """Limit of the integral of the error; 0 for none."""
    slew: float = 0.0
    """Limit of the setpoint's rate; 0 for none."""
    input_gain: float = 1.0
    """Setpoint per unit of the control."""
    stall: float = math.inf
    """Effort at stall; with the speed without load, the line between them."""
    speed: float = math.inf
    lag: float = 0.0
    """Time constant of the effort [s]."""

    @property
    def is_servo(self) -> bool:
        """Whether its control is a setpoint, not an effort."""
        return any((self.kp, self.ki, self.kv))

    @property
    def adds(self) -> bool:
        """Whether several actuators of one joint with such laws are one with the sum of gains."""
        return self == ActuatorLaw(self.kp, kv=self.kv, input_gain=self.input_gain)


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
    ki: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    kd: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    """Gains of servos."""
    integral_limit: dict[str, float] = field(default_factory=dict)
    setpoints: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Range of the setpoints of a servo."""
    setpoint_rate: dict[str, float] = field(default_factory=dict)
    saturation_effort: dict[str, float] = field(default_factory=dict)
    no_load_speed: dict[str, float] = field(default_factory=dict)
    lag: dict[str, float] = field(default_factory=dict)


def read_couplings(robot: RobotInFile) -> Couplings:
    """Return the joints that linear equalities couple: y - y0 = c0 + c1 (x - x0), with y0, x0 the
    reference pose.
    """
    model = robot.model
    couplings: Couplings = {}
    others: list[str] = []
    for equality in np.flatnonzero(model.eq_active0).tolist():
        follower = int(model.eq_obj1id[equality])
        leader = int(model.eq_obj2id[equality])
        if model.eq_type[equality] != _EQ.mjEQ_JOINT or follower not in robot.joints:
            others.append(label(model.equality(equality)))
            continue
        name = robot.joints[follower]
        offset, multiplier, *higher = model.eq_data[equality, :5].tolist()
        is_linear = leader in robot.joints and multiplier and not any(higher)
        if not is_linear or name in couplings:
            text = "without the joint's equality, which is not linear in one other joint"
            robot.lose(text, name)
            continue
        rest, rest_of_leader = model.qpos0[model.jnt_qposadr[[follower, leader]]].tolist()
        offset += rest - multiplier * rest_of_leader
        couplings[name] = robot.joints[leader], multiplier, offset
    if others:
        text = "closed loops are open, without the equality constraints other than between the"
        robot.lose(f"{text} robot's joints: {', '.join(others)}")
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
    numbers = range(len(model.actuator_trntype))
    arms_of = [_on_leaders(_arms(model, actuator, robot), couplings) for actuator in numbers]
    counts = Counter(name for arms in arms_of for name in arms)
    for actuator, arms in enumerate(arms_of):
        law = _law(model, actuator)
        is_read = len(arms) == 1 and _is_plain(model, actuator, law)
        if not is_read or not (law.adds or counts[next(iter(arms))] == 1):
            text = f"actuator {label(model.actuator(actuator))} has effects that are not simulated"
            text += ": only motors and servos of one joint are"
            remedy = "check gains and limits of the joint"
            findings += [Finding("actuator", text, remedy, name) for name in arms or [None]]
            law = ActuatorLaw(law.kp, kv=law.kv) if len(arms) == 1 else ActuatorLaw()
        for name, arm in arms.items():
            _add_limits(
                model,
                actuator,
                name,
                arm,
                motors,
                findings,
            )
            _add_law(law, name, arm, motors)
        if law.is_servo:
            _add_setpoints(model, actuator, law, robot, motors)
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
    tendons = [
        label(model.tendon(tendon))
        for tendon in range(model.ntendon)
        if any(np.any(getattr(model, f"tendon_{effect}")[tendon]) for effect in _OF_TENDONS)
    ]
    if tendons:
        text = "joints move freely, without springs, damping, friction, armature and limits of tendons: "
        robot.lose(text + ", ".join(tendons))
    return motors


def _is_plain(model: MjModel, actuator: int, law: ActuatorLaw) -> bool:
    """Return whether an actuator is a motor, or has this ``law``, without further effects."""
    effects = ("delay", "damping", "dampingpoly")
    if model.actuator_plugin[actuator] >= 0:
        return False
    if any(np.any(getattr(model, f"actuator_{effect}")[actuator]) for effect in effects):
        return False
    # The file may switch off the actuators of a group.
    group = int(model.actuator_group[actuator])
    if 0 <= group <= 30 and model.opt.disableactuator & (1 << group):
        return False
    gain, bias, dynamics = (
        getattr(model, f"actuator_{name}prm")[actuator] for name in ("gain", "bias", "dyn")
    )
    kind = int(model.actuator_gaintype[actuator])
    inputs = int(model.actuator_ctrlspec[actuator])
    if kind == _GAIN.mjGAIN_DCMOTOR:
        # Without cogging, heat and friction of its own. A voltage is no effort, nor a setpoint.
        others = (*gain[2:4], *bias, *dynamics[1:7])
        controls = inputs & _INPUT.mjINPUT_POS or (inputs == _INPUT.mjINPUT_FF and not law.is_servo)
        return bool(controls and not any(others))
    constant, stiffness, damping = bias[:3].tolist()
    is_affine = model.actuator_biastype[actuator] == _BIAS.mjBIAS_AFFINE
    is_law = is_affine and constant == 0 and stiffness <= 0 and damping <= 0
    if kind == _GAIN.mjGAIN_PID:
        return bool(is_law and inputs & _INPUT.mjINPUT_POS)
    is_direct = model.actuator_dyntype[actuator] == _DYN.mjDYN_NONE
    if kind != _GAIN.mjGAIN_FIXED or gain[0] == 0 or not is_direct:
        return False
    is_motor = model.actuator_biastype[actuator] == _BIAS.mjBIAS_NONE
    return bool(is_motor or (is_law and (stiffness < 0 or damping == 0)))


def _law(model: MjModel, actuator: int) -> ActuatorLaw:
    """Return the law of an actuator; that of a motor for unknown laws."""
    # A plugin's parameters have other meanings.
    if model.actuator_plugin[actuator] >= 0:
        return ActuatorLaw()
    kind = int(model.actuator_gaintype[actuator])
    gain = model.actuator_gainprm[actuator].tolist()
    dynamics = model.actuator_dynprm[actuator].tolist()
    if kind == _GAIN.mjGAIN_DCMOTOR:
        resistance, constant, _, _, kp, ki, kv, supply, *_ = gain
        law = ActuatorLaw(
            kp,
            ki,
            kv,
            error_limit=dynamics[8],
            slew=dynamics[7],
            lag=dynamics[0],
        )
        if supply:
            law = law._replace(stall=constant * supply / resistance, speed=supply / constant)
        return law
    if model.actuator_biastype[actuator] != _BIAS.mjBIAS_AFFINE:
        return ActuatorLaw()
    kp, kv = np.maximum(-model.actuator_biasprm[actuator, 1:3], 0.0).tolist()
    if kind == _GAIN.mjGAIN_PID:
        return ActuatorLaw(kp, gain[0], kv, error_limit=dynamics[0], slew=dynamics[1])
    if kind == _GAIN.mjGAIN_FIXED and kp:
        return ActuatorLaw(kp, kv=kv, input_gain=gain[0] / kp)
    return ActuatorLaw(kp, kv=kv)


def _add_law(law: ActuatorLaw, name: str, arm: float, motors: JointMotors) -> None:
    """Add gains and motor of an actuator to a joint."""
    motors.kp[name] += arm**2 * law.kp
    motors.ki[name] += arm**2 * law.ki
    motors.kd[name] += arm**2 * law.kv
    if law.ki and law.error_limit:
        motors.integral_limit[name] = abs(arm) * law.ki * law.error_limit
    if law.slew:
        motors.setpoint_rate[name] = law.slew / abs(arm)
    if math.isfinite(law.stall):
        motors.saturation_effort[name] = abs(arm) * law.stall
        motors.no_load_speed[name] = law.speed / abs(arm)
    if law.lag:
        motors.lag[name] = law.lag


def _add_setpoints(
    model: MjModel,
    actuator: int,
    law: ActuatorLaw,
    robot: RobotInFile,
    motors: JointMotors,
) -> None:
    """Add the range of a servo's setpoints, where its transmission moves with one joint alone."""
    arms = _arms(model, actuator, robot)
    control = int(model.actuator_ctrladr[actuator])
    if len(arms) == 1 and law.kp and model.actuator_ctrllimited[control]:
        ((name, arm),) = arms.items()
        ends = law.input_gain * model.actuator_ctrlrange[control] / arm
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
    gains = {
        int(_GAIN.mjGAIN_FIXED): float(model.actuator_gainprm[actuator, 0]),
        int(_GAIN.mjGAIN_DCMOTOR): 1.0,
    }
    gain = gains.get(int(model.actuator_gaintype[actuator]))
    is_force = (
        int(model.actuator_dyntype[actuator]) in _FILTERS
        or model.actuator_ctrlspec[actuator] == _INPUT.mjINPUT_FF
    )
    is_motor = gain is not None and not _law(model, actuator).is_servo
    if is_motor and is_force and model.actuator_ctrllimited[control]:
        forces = gain * model.actuator_ctrlrange[control]
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
