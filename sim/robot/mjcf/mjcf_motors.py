"""Actuators and coupled joints of a compiled MJCF file, as effort limits, armature, gains and mimic
joints.

An actuator with force F and moment arm g on a joint (the gear, times the joint's coefficient in a
fixed tendon) applies the effort g F; a follower q' = m q adds m g' to the arm on its leader. A
servo F = k u + b - kp g q - kv g q' has the gains g^2 kp and g^2 kv of a PID whose setpoint is its
target in units of the joint. (MuJoCo's documentation, "Computation", actuation model.)
"""

from __future__ import annotations

import math
from collections import defaultdict
from typing import Any, NamedTuple

import mujoco
import numpy as np

from batchpid.arrays.array_types import MjModel
from batchpid.sim.robot.findings import Finding
from batchpid.sim.robot.mjcf.mjcf_compiler import ALONE, Names, label
from batchpid.sim.robot.mjcf.mjcf_laws import (
    Line,
    input_range,
    is_motor,
    line_of,
    servo_of,
    setpoint_range,
    unread,
)

Couplings = dict[str, tuple[str, float, float]]
"""Leader, multiplier and offset of each follower, as in ``<mimic>``."""
_TRN, _EQ = mujoco.mjtTrn, mujoco.mjtEq


class Motors(NamedTuple):
    """Quantities of the joints by name, in N m or N."""

    effort_limit: dict[str, float]
    """Infinite where the file gives none."""
    armature: dict[str, float]
    """Reflected inertia [kg m^2 or kg]; a follower's armature is added to its leader's."""
    damping: dict[str, float]
    """Damping of the actuators, in addition to the joints'."""
    kp: dict[str, float]
    kv: dict[str, float]
    """Gains of servos; joints without servo are left out."""
    ki: dict[str, float]
    imax: dict[str, float]
    """Limits of the integral of the error [rad s or m s]; joints without one are left out."""
    rate: dict[str, float]
    """Limits of the setpoint's rate [rad/s or m/s]; joints without one are left out."""
    saturation_effort: dict[str, float]
    no_load_speed: dict[str, float]
    lag: dict[str, float]
    """Torque-speed lines and time constants [s] of DC motors; joints without one are left out."""


def read_couplings(model: MjModel, names: Names, findings: list[Finding]) -> Couplings:
    """Return the joints that linear equalities couple: y - y0 = c0 + c1 (x - x0), with y0, x0 the
    reference pose.
    """
    couplings: Couplings = {}
    others: list[str] = []
    for equality in map(int, np.flatnonzero(model.eq_active0)):
        kind = _EQ(model.eq_type[equality]).name.removeprefix("mjEQ_").lower()
        named = f"{kind} {label(model.equality(equality))}"
        if (
            model.eq_type[equality] != _EQ.mjEQ_JOINT
            or int(model.eq_obj1id[equality]) not in names.joints
        ):
            others.append(named)
            continue
        follower, leader = int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality])
        name = names.joints[follower]
        offset, multiplier, *higher = model.eq_data[equality, :5].tolist()
        problem = None
        if leader >= 0 and leader not in names.joints:
            problem = f"{ALONE} an equality that couples the joint to {label(model.joint(leader))}"
        elif leader < 0:
            problem = f"{ALONE} an equality that holds the joint at a position"
        elif any(higher) or multiplier == 0:
            problem = (
                f"{ALONE} an equality that couples the joint to {names.joints[leader]!r}"
                " nonlinearly"
            )
        elif name in couplings:
            problem = f"{ALONE} the second of several equalities of the joint"
        if problem is not None:
            findings.append(
                Finding("warning", "mimic", problem, "give the joint a setpoint of its own", name)
            )
            continue
        rest, rest_of_leader = (
            float(model.qpos0[model.jnt_qposadr[joint]]) for joint in (follower, leader)
        )
        couplings[name] = (
            names.joints[leader],
            multiplier,
            rest + offset - multiplier * rest_of_leader,
        )
    if others:
        text = f"{ALONE} equality constraints other than of the robot's joints: {', '.join(others)}"
        findings.append(
            Finding("warning", "equality", text, "in SAPIEN expect closed loops to be open")
        )
    if inactive := [
        label(model.equality(int(equality))) for equality in np.flatnonzero(model.eq_active0 == 0)
    ]:
        text = (
            "equality constraints that the file has switched off are left out:"
            f" {', '.join(inactive)}"
        )
        findings.append(Finding("note", "equality", text, "expect no effect"))
    return couplings


def read_motors(
    model: MjModel, names: Names, couplings: Couplings, findings: list[Finding]
) -> Motors:
    """Return the effects of the model's actuators on its joints, with findings for effects that are
    not simulated.
    """
    armature = {
        name: float(model.dof_armature[model.jnt_dofadr[joint]])
        for joint, name in names.joints.items()
    }
    damping = dict.fromkeys(armature, 0.0)
    limits: dict[str, float] = defaultdict(float)
    kp: dict[str, float] = defaultdict(float)
    kv: dict[str, float] = defaultdict(float)
    ki: dict[str, float] = defaultdict(float)
    most: dict[str, float] = defaultdict(float)  # limits of the integrals as efforts
    rate: dict[str, float] = {}
    speed_of_target: dict[
        str, float
    ] = {}  # limits of velocity servos, which count without a position servo
    lines: dict[str, Line] = {}
    driven: dict[str, int] = defaultdict(int)
    pull: dict[int, float] = {}  # what limited tendons leave to their further actuators
    for actuator in range(
        len(model.actuator_trntype)
    ):  # nu counts inputs, of which <pid> has up to three
        arms = _arms(model, actuator, names)
        name_of = f"actuator {label(model.actuator(actuator))}"
        leading = _leading(arms or {}, couplings)
        if not leading:
            text = (
                "acts on no joint of the robot, or by a spatial tendon"
                if arms is None
                else "has moment arms of 0"
            )
            remedy = "expect every joint to have a motor of its own"
            findings.append(Finding("warning", "actuator", f"{name_of} {text}: left out", remedy))
            continue
        for name, arm in leading.items():
            armature[name] += arm**2 * _field(model, "actuator_armature", actuator)
            damping[name] += arm**2 * _field(model, "actuator_damping", actuator)
        for name in leading:
            driven[name] += 1
        first, single = next(iter(leading)), len(leading) == 1
        if not single:
            text = (
                f"{name_of} pulls several joints: each has a motor of its own here, as strong"
                " as all"
            )
            findings += [
                Finding("warning", "actuator", text, "control them together", name)
                for name in leading
            ]
        servo = servo_of(model, actuator)
        findings += [
            Finding("warning", "actuator", f"{name_of} {text}", remedy, first, detail=detail)
            for text, remedy, detail in unread(model, actuator, servo)
        ]
        if line := line_of(model, actuator):
            for name, arm in leading.items():
                damping[name] += arm**2 * line.damping
            if single:
                arm = abs(leading[first])
                lines[first] = line._replace(stall=arm * line.stall, speed=line.speed / arm)
        if (delay := _field(model, "actuator_delay", actuator)) > 0:
            text = f"{name_of} has a delay, which is not simulated"
            remedy = "give command_delay= to make_actuators"
            findings.append(
                Finding("warning", "actuator", text, remedy, first, detail=f"{delay:g} s")
            )
        force = _force_limit(model, actuator, first, findings)
        tendon = int(model.actuator_trnid[actuator, 0])
        if (
            model.actuator_trntype[actuator] == _TRN.mjTRN_TENDON
            and model.tendon_actfrclimited[tendon]
        ):
            if tendon not in pull:
                pull[tendon] = _magnitude(model.tendon_actfrcrange[tendon], first, findings)
            force = min(force, pull[tendon])
            pull[tendon] -= force
        for name, arm in leading.items():
            limits[name] += abs(arm) * force
            if servo is not None and single:
                kp[name] += max(arm**2 * servo.kp, 0.0)
                kv[name] += max(arm**2 * servo.kv, 0.0)
                ki[name] += max(arm**2 * servo.ki, 0.0)
                most[name] += abs(arm) * servo.ki * servo.imax if servo.ki > 0 else 0.0
                findings += _narrower(
                    model, names, name, setpoint_range(model, actuator, servo), arm
                )
                if 0 < servo.rate < math.inf:
                    slowest = rate if servo.kp > 0 else speed_of_target
                    slowest[name] = min(slowest.get(name, math.inf), servo.rate / abs(arm))
    rate |= {name: value for name, value in speed_of_target.items() if kp[name] == 0}
    for name in [name for name in lines if driven[name] > 1]:
        del lines[name]
        text = (
            "a DC motor is one of several actuators of the joint: its torque-speed line and lag are"
            " not simulated"
        )
        findings.append(
            Finding("warning", "actuator", text, "give them to make_actuators for the joint", name)
        )
    imax = {
        name: most[name] / gain for name, gain in ki.items() if gain and math.isfinite(most[name])
    }
    own, armature = (
        armature,
        {name: value * (name not in couplings) for name, value in armature.items()},
    )
    for follower in couplings:
        for leader, multiplier in _leading({follower: 1.0}, couplings).items():
            armature[leader] += multiplier**2 * own[follower]
    for joint, name in names.joints.items():
        limits.setdefault(name, math.inf)
        if model.jnt_actfrclimited[joint]:
            limits[name] = min(
                limits[name], _magnitude(model.jnt_actfrcrange[joint], name, findings)
            )
        if model.nu and name not in driven and name not in couplings:
            text = "no actuator of the file moves the joint: it is controlled as all others"
            findings.append(
                Finding(
                    "warning", "actuator", text, "give it gains of 0 to let it move freely", name
                )
            )
    findings += _tendons(model)
    stall = {name: line.stall for name, line in lines.items() if math.isfinite(line.stall)}
    speed = {name: lines[name].speed for name in stall}
    lag = {name: line.lag for name, line in lines.items() if line.lag}
    return Motors(
        dict(limits), armature, damping, dict(kp), dict(kv), dict(ki), imax, rate, stall, speed, lag
    )


def _narrower(
    model: MjModel, names: Names, name: str, ends: tuple[float, float], arm: float
) -> list[Finding]:
    """Return a finding if a servo limits the setpoint of a joint to less than the joint's range."""
    joint = next(joint for joint, each in names.joints.items() if each == name)
    low, high = sorted(end / arm for end in ends)
    lower, upper = model.jnt_range[joint] if model.jnt_limited[joint] else (-math.inf, math.inf)
    margin = 1e-3 * (upper - lower) if math.isfinite(upper - lower) else 0.0
    if low <= lower + margin and high >= upper - margin:
        return []
    text, remedy = (
        "the setpoint is not limited to the range that the servo has in the file",
        "pass make_guard(lower=...)",
    )
    return [Finding("note", "actuator", text, remedy, name, detail=f"{low:g} to {high:g}")]


def _field(model: MjModel, name: str, index: int) -> float:
    values = getattr(
        model, name, None
    )  # older versions have neither armature nor damping of actuators
    return 0.0 if values is None else float(values[index])


def roots_of_actuators(model: MjModel) -> set[int]:
    """Return the children of the world that actuators move, either themselves or bodies below
    them.
    """
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    dofs = data.moment_colind[: data.moment_rownnz.sum()]
    return {int(body) for body in model.body_rootid[model.dof_bodyid[dofs]]}


def _arms(model: MjModel, actuator: int, names: Names) -> dict[str, float] | None:
    """Return the moment arms of an actuator on the joints that it acts on by a constant arm, by
    name; else None.
    """
    kind, target = int(model.actuator_trntype[actuator]), int(model.actuator_trnid[actuator, 0])
    outputs = getattr(
        model, "actuator_outadr", None
    )  # an orientation servo has three, each with a gear
    gear = float(model.actuator_gear[actuator if outputs is None else int(outputs[actuator]), 0])
    if kind in (_TRN.mjTRN_JOINT, _TRN.mjTRN_JOINTINPARENT):
        return {names.joints[target]: gear} if target in names.joints else None
    if kind != _TRN.mjTRN_TENDON:
        return None
    wraps = range(
        int(model.tendon_adr[target]), int(model.tendon_adr[target] + model.tendon_num[target])
    )
    if any(model.wrap_type[wrap] != mujoco.mjtWrap.mjWRAP_JOINT for wrap in wraps):
        return None
    if any(int(model.wrap_objid[wrap]) not in names.joints for wrap in wraps):
        return None
    arms: dict[str, float] = defaultdict(float)
    for wrap in wraps:
        arms[names.joints[int(model.wrap_objid[wrap])]] += gear * float(model.wrap_prm[wrap])
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


def _force_limit(model: MjModel, actuator: int, name: str, findings: list[Finding]) -> float:
    """Return the largest magnitude of an actuator's force that both its signs reach."""
    low, high = -math.inf, math.inf
    if model.actuator_forcelimited[actuator]:
        low, high = model.actuator_forcerange[actuator].tolist()
    if is_motor(model, actuator) and (ends := input_range(model, actuator)) is not None:
        least, most = sorted((model.actuator_gainprm[actuator, 0] * ends).tolist())
        low, high = max(low, least), min(high, most)
    return _magnitude((low, high), name, findings)


def _magnitude(ends: Any, name: str, findings: list[Finding]) -> float:
    """Return the magnitude of a symmetric range, else the smaller one that is not zero, with a
    finding.
    """
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


def _tendons(model: MjModel) -> list[Finding]:
    """Return findings of tendons that act on the joints by themselves, and of tendons that do not
    act.
    """
    effects = (
        "stiffness",
        "stiffnesspoly",
        "damping",
        "dampingpoly",
        "frictionloss",
        "armature",
        "limited",
    )
    passive = [
        getattr(model, f"tendon_{name}", np.zeros(model.ntendon)) for name in effects
    ]  # by version
    acting = [
        tendon for tendon in range(model.ntendon) if any(np.any(field[tendon]) for field in passive)
    ]
    pulled = {*model.actuator_trnid[model.actuator_trntype == _TRN.mjTRN_TENDON, 0].tolist()}
    idle = [
        tendon for tendon in range(model.ntendon) if tendon not in pulled and tendon not in acting
    ]
    found = []
    if acting:
        text = f"{ALONE} springs, damping, friction, armature and limits of tendons: "
        text += ", ".join(label(model.tendon(tendon)) for tendon in acting)
        found.append(
            Finding("warning", "tendon", text, "in SAPIEN expect their joints to move freely")
        )
    if idle:
        text = (
            "tendons without an effect are left out:"
            f" {', '.join(label(model.tendon(tendon)) for tendon in idle)}"
        )
        found.append(Finding("note", "tendon", text, "expect no effect"))
    return found
