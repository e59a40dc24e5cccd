"""Actuators and coupled joints of a compiled MJCF file, as effort limits, armature, gains and mimic
joints.

An actuator with force F and moment arm g on a joint (the gear, times the joint's coefficient in a
fixed tendon) applies the effort g F; a follower q' = m q adds m g' to the arm on its leader. A
servo F = k u - kp g q - kv g q' has the gains g^2 kp and g^2 kv of a PID whose setpoint is its
target in units of the joint. (MuJoCo's documentation, "Computation", actuation model.)

Motors and servos are read. A finding names every other effect of an actuator.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np

from batchpid.arrays.array_types import MjModel
from batchpid.sim.robot.findings import Finding
from batchpid.sim.robot.mjcf.mjcf_compiler import ALONE, Names, label

Couplings = dict[str, tuple[str, float, float]]
"""Leader, multiplier and offset of each follower, as in ``<mimic>``."""
_TRN, _EQ = mujoco.mjtTrn, mujoco.mjtEq
_GAIN, _BIAS, _DYN = mujoco.mjtGain, mujoco.mjtBias, mujoco.mjtDyn
_POSITION = 1
"""Bit of a position among the inputs of a <pid> (``mjtCtrlInput``)."""
_FILTERS = (int(_DYN.mjDYN_NONE), int(_DYN.mjDYN_FILTER), int(_DYN.mjDYN_FILTEREXACT))
"""Dynamics whose state follows the control, so that the control's range limits the force."""


@dataclass(frozen=True)
class Motors:
    """Motors of the joints by name, in N m or N."""

    effort_limit: dict[str, float] = field(default_factory=dict)
    """Infinite where the file gives none."""
    armature: dict[str, float] = field(default_factory=dict)
    """Reflected inertia [kg m^2 or kg]; a follower's armature is added to its leader's."""
    kp: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    kv: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    """Gains of servos; 0 for joints without."""


def read_couplings(model: MjModel, names: Names, findings: list[Finding]) -> Couplings:
    """Return the joints that linear equalities couple: y - y0 = c0 + c1 (x - x0), with y0, x0 the
    reference pose.
    """
    couplings: Couplings = {}
    others: list[str] = []
    for equality in map(int, np.flatnonzero(model.eq_active0)):
        follower = int(model.eq_obj1id[equality])
        leader = int(model.eq_obj2id[equality])
        if model.eq_type[equality] != _EQ.mjEQ_JOINT or follower not in names.joints:
            kind = _EQ(model.eq_type[equality]).name.removeprefix("mjEQ_").lower()
            others.append(f"{kind} {label(model.equality(equality))}")
            continue
        # From here on it couples joints of the robot: one leader, linear, or a finding.
        name = names.joints[follower]
        offset, multiplier, *higher = model.eq_data[equality, :5].tolist()
        problem = None
        if leader >= 0 and leader not in names.joints:
            problem = f"couples the joint to {label(model.joint(leader))}"
        elif leader < 0:
            problem = "holds the joint at a position"
        elif any(higher) or multiplier == 0:
            problem = f"couples the joint to {names.joints[leader]!r} nonlinearly"
        elif name in couplings:
            problem = "is the second of the joint"
        if problem is not None:
            text = f"{ALONE} an equality that {problem}"
            remedy = "give the joint a setpoint"
            findings.append(Finding("warning", "mimic", text, remedy, name))
            continue
        rest, rest_of_leader = model.qpos0[model.jnt_qposadr[[follower, leader]]].tolist()
        offset += rest - multiplier * rest_of_leader
        couplings[name] = names.joints[leader], multiplier, offset
    if others:
        text = f"{ALONE} equality constraints other than of the robot's joints: {', '.join(others)}"
        remedy = "in SAPIEN expect closed loops to be open"
        findings.append(Finding("warning", "equality", text, remedy))
    return couplings


def read_motors(
    model: MjModel, names: Names, couplings: Couplings, findings: list[Finding]
) -> Motors:
    """Return the motors of the joints, with findings for effects that are not simulated."""
    motors = Motors()
    for joint, name in names.joints.items():
        motors.armature[name] = float(model.dof_armature[model.jnt_dofadr[joint]])
    # nu counts inputs, of which some actuators have several.
    for actuator in range(len(model.actuator_trntype)):
        arms = _leading(_arms(model, actuator, names), couplings)
        effects = [*_effects(model, actuator)]
        if len(arms) > 1:
            effects.append("a pull on several joints: each has a motor as strong as all")
        if not arms:
            effects = ["no constant moment arm on a joint of the robot: it is left out"]
        if effects:
            named = f"actuator {label(model.actuator(actuator))}"
            text = f"{named} has effects that are not simulated: {', '.join(effects)}"
            remedy = "check gains and limits of the joint"
            findings += [
                Finding("warning", "actuator", text, remedy, name) for name in arms or [None]
            ]
        for name, arm in arms.items():
            _add(model, actuator, name, arm, motors, findings)
            if len(arms) == 1:
                _add_gains(model, actuator, name, arm, motors)
    # A follower has no motor: its leader moves its armature, too.
    armature = dict(motors.armature)
    for follower in couplings:
        motors.armature[follower] = 0.0
    for follower in couplings:
        for leader, multiplier in _leading({follower: 1.0}, couplings).items():
            motors.armature[leader] += multiplier**2 * armature[follower]
    for joint, name in names.joints.items():
        if model.nu and name not in motors.effort_limit and name not in couplings:
            text = "no actuator of the file moves the joint: it is controlled as all others"
            remedy = "give it gains of 0 to let it move freely"
            findings.append(Finding("warning", "actuator", text, remedy, name))
        # A limit of 0 counts as none.
        limit = motors.effort_limit.get(name, math.inf) or math.inf
        if model.jnt_actfrclimited[joint]:
            limit = min(limit, _magnitude(model.jnt_actfrcrange[joint], name, findings))
        motors.effort_limit[name] = limit
    findings += _tendons(model)
    return motors


def _add(
    model: MjModel, actuator: int, name: str, arm: float, motors: Motors, findings: list[Finding]
) -> None:
    """Add armature and effort limit of an actuator to a joint."""
    motors.armature[name] += arm**2 * _field(model, "actuator_armature", actuator)
    low, high = -math.inf, math.inf
    if model.actuator_forcelimited[actuator]:
        low, high = model.actuator_forcerange[actuator].tolist()
    ends = _input_range(model, actuator)
    # The range of a servo's control is one of positions, not of forces.
    if ends is not None and _servo(model, actuator) == (0.0, 0.0):
        least, most = sorted((model.actuator_gainprm[actuator, 0] * ends).tolist())
        low = max(low, least)
        high = min(high, most)
    force = _magnitude((low, high), name, findings)
    tendon = int(model.actuator_trnid[actuator, 0])
    if model.actuator_trntype[actuator] == _TRN.mjTRN_TENDON and model.tendon_actfrclimited[tendon]:
        force = min(force, _magnitude(model.tendon_actfrcrange[tendon], name, findings))
    motors.effort_limit[name] = motors.effort_limit.get(name, 0.0) + abs(arm) * force


def _servo(model: MjModel, actuator: int) -> tuple[float, float]:
    """Return the gains kp and kv of an actuator, both 0 for a motor and for unknown laws."""
    # A plugin's parameters have other meanings.
    is_known = model.actuator_plugin[actuator] < 0
    if is_known and model.actuator_biastype[actuator] == _BIAS.mjBIAS_AFFINE:
        kp, kv = (-model.actuator_biasprm[actuator, 1:3]).tolist()
        return kp, kv
    return 0.0, 0.0


def _add_gains(model: MjModel, actuator: int, name: str, arm: float, motors: Motors) -> None:
    kp, kv = _servo(model, actuator)
    motors.kp[name] += arm**2 * max(kp, 0.0)
    motors.kv[name] += arm**2 * max(kv, 0.0)


def _effects(model: MjModel, actuator: int) -> Iterator[str]:
    """Yield the effects of an actuator beyond a motor or servo."""
    gain_type, bias_type, dynamics = (
        int(getattr(model, f"actuator_{kind}type")[actuator]) for kind in ("gain", "bias", "dyn")
    )
    kp, kv = _servo(model, actuator)
    gain = model.actuator_gainprm[actuator, 0]
    constant = model.actuator_biasprm[actuator, 0]
    group = int(model.actuator_group[actuator])
    if model.actuator_plugin[actuator] >= 0:
        yield "a plugin"
        return
    # A <pid> has a law of its own; the rest is about <general> and its shortcuts.
    if _is_pid(model, actuator):
        if dynamics != _DYN.mjDYN_NONE:
            yield "an integral, or a limit of the setpoint's rate"
        if not int(model.actuator_ctrlspec[actuator]) & _POSITION:
            yield "no input of a position: it is a spring here with the setpoint as its position"
        return
    if gain_type != _GAIN.mjGAIN_FIXED:
        yield f"gains of type {_GAIN(gain_type).name.removeprefix('mjGAIN_').lower()}"
    if bias_type not in (int(_BIAS.mjBIAS_NONE), int(_BIAS.mjBIAS_AFFINE)):
        yield f"a bias of type {_BIAS(bias_type).name.removeprefix('mjBIAS_').lower()}"
    if bias_type == _BIAS.mjBIAS_AFFINE and constant:
        yield "a constant force"
    if dynamics != _DYN.mjDYN_NONE:
        yield "dynamics of its own"
    if min(kp, kv) < 0:
        yield "a negative gain, which is 0 here"
    if gain_type == _GAIN.mjGAIN_FIXED and gain == 0:
        yield "no input: a spring has the setpoint as its position, a damper the gain kd"
    elif kp == 0 < kv:
        yield "a velocity as its target: its gain kv is the gain kd, which damps"
    for name in ("delay", "damping"):
        if _field(model, f"actuator_{name}", actuator):
            yield f"a {name}"
    if 0 <= group <= 30 and model.opt.disableactuator & (1 << group):
        yield "no effect in the file, which disables its group"


def _is_pid(model: MjModel, actuator: int) -> bool:
    """Return whether an actuator is MuJoCo's <pid> (3.12 and later)."""
    return bool(model.actuator_gaintype[actuator] == getattr(_GAIN, "mjGAIN_PID", None))


def _input_range(model: MjModel, actuator: int) -> Any | None:
    """Return the range of an actuator's control; None without one, or with dynamics of which the
    state is limited instead.
    """
    is_linear = model.actuator_gaintype[actuator] == _GAIN.mjGAIN_FIXED
    is_linear &= int(model.actuator_dyntype[actuator]) in _FILTERS
    if not (is_linear or _is_pid(model, actuator)):
        return None
    first = actuator
    if hasattr(model, "actuator_ctrladr"):  # older versions have one input for each actuator
        first = int(model.actuator_ctrladr[actuator])
    if model.actuator_ctrllimited[first]:
        return model.actuator_ctrlrange[first]
    return None


def _field(model: MjModel, name: str, index: int) -> float:
    """Return an entry of a field that older versions of MuJoCo do not have, 0 there."""
    values = getattr(model, name, None)
    if values is None:
        return 0.0
    return float(np.ravel(values[index])[0])


def _arms(model: MjModel, actuator: int, names: Names) -> dict[str, float]:
    """Return the moment arms of an actuator on the joints that it acts on by a constant arm, by
    name; none if it acts otherwise.
    """
    kind = int(model.actuator_trntype[actuator])
    target = int(model.actuator_trnid[actuator, 0])
    outputs = getattr(model, "actuator_outadr", None)  # several of an orientation servo
    gear = float(model.actuator_gear[actuator if outputs is None else int(outputs[actuator]), 0])
    if kind in (_TRN.mjTRN_JOINT, _TRN.mjTRN_JOINTINPARENT):
        if target in names.joints:
            return {names.joints[target]: gear}
        return {}
    if kind != _TRN.mjTRN_TENDON:
        return {}
    arms: dict[str, float] = defaultdict(float)
    first = int(model.tendon_adr[target])
    for wrap in range(first, first + int(model.tendon_num[target])):
        joint = int(model.wrap_objid[wrap])
        if model.wrap_type[wrap] != mujoco.mjtWrap.mjWRAP_JOINT or joint not in names.joints:
            return {}
        arms[names.joints[joint]] += gear * float(model.wrap_prm[wrap])
    return dict(arms)


def _leading(arms: dict[str, float], couplings: Couplings) -> dict[str, float]:
    """Return the moment arms on the independent joints, with those on their followers."""
    leading: dict[str, float] = defaultdict(float)
    for name, arm in arms.items():
        for _ in couplings:  # at most as many leaders of leaders
            if name in couplings:
                name, arm = couplings[name][0], arm * couplings[name][1]
        leading[name] += arm
    return {name: arm for name, arm in leading.items() if arm}


def _magnitude(ends: Any, name: str, findings: list[Finding]) -> float:
    """Return the magnitude of a symmetric range, else the smaller one that is not zero, with a
    finding.
    """
    # Limits here are symmetric; the smaller is safe in both directions.
    magnitudes = sorted(abs(float(end)) for end in ends)
    if magnitudes[0] != magnitudes[1]:
        text = (
            "the limits of the effort differ by direction: the smaller one that is not zero holds"
            " in both"
        )
        detail = f"{min(ends):g} to {max(ends):g}"
        remedy = "pass effort_min= and effort_max= to robot.params()"
        findings.append(Finding("warning", "limits", text, remedy, name, detail=detail))
    return magnitudes[0] or magnitudes[1]


def _tendons(model: MjModel) -> Iterator[Finding]:
    """Yield a finding of tendons that act on the joints by themselves."""
    effects = "stiffness", "damping", "frictionloss", "armature", "limited"
    acting = [
        label(model.tendon(tendon))
        for tendon in range(model.ntendon)
        if any(np.any(getattr(model, f"tendon_{name}")[tendon]) for name in effects)
    ]
    if acting:
        text = f"{ALONE} springs, damping, friction, armature and limits of tendons: "
        remedy = "in SAPIEN expect their joints to move freely"
        yield Finding("warning", "tendon", text + ", ".join(acting), remedy)
