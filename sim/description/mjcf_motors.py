"""Actuators and coupled joints of a compiled MJCF file, as effort limits, armature, gains and mimic
joints.

An actuator with force F and moment arm g on a joint (the gear, times the joint's coefficient in a
fixed tendon) applies the effort g F; a follower q' = m q adds m g' to the arm on its leader. A
servo F = k u - kp g q - kv g q' has the gains g^2 kp and g^2 kv of a PID whose setpoint is its
target in units of the joint. (MuJoCo's documentation, "Computation", actuation model.)

Motors and position servos of one joint are read. A finding names every other actuator; the damping
of a velocity servo is read as well.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import mujoco
import numpy as np

from batchpid.arrays.array_types import Bool, Float64, MjModel
from batchpid.sim.description.mjcf_bodies import RobotInFile, label
from batchpid.sim.findings import Finding

Couplings = dict[int, tuple[int, float, float]]
"""Leader, multiplier and offset of each follower, as in ``<mimic>``, by the joints' numbers."""
_TRN, _EQ = mujoco.mjtTrn, mujoco.mjtEq
_GAIN, _BIAS, _DYN = mujoco.mjtGain, mujoco.mjtBias, mujoco.mjtDyn
_FILTERS = (_DYN.mjDYN_NONE, _DYN.mjDYN_FILTER, _DYN.mjDYN_FILTEREXACT)
"""Dynamics whose state follows the control, so that the control's range limits the force."""


class JointMotors(NamedTuple):
    """Motors of the joints (joints,), in N m or N, by the joints' numbers in the file."""

    effort_limit: Float64
    """Infinite where the file gives none."""
    armature: Float64
    """Reflected inertia [kg m^2 or kg]; a follower's armature is added to its leader's."""
    kp: Float64
    kd: Float64
    """Gains of servos."""
    setpoints: Float64
    """Range of the setpoints of a servo (2, joints), infinite where the file gives none."""
    unmoved: Bool
    """Joints that no actuator moves, in a file with actuators."""


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
            continue
        offset, multiplier, *higher = model.eq_data[equality, :5].tolist()
        is_linear = leader in robot.joints and multiplier and not any(higher)
        if not is_linear or follower in couplings:
            continue
        rest, rest_of_leader = model.qpos0[model.jnt_qposadr[[follower, leader]]].tolist()
        offset += rest - multiplier * rest_of_leader
        couplings[follower] = leader, multiplier, offset
    return couplings


def read_motors(robot: RobotInFile, couplings: Couplings) -> JointMotors:
    """Return the motors of the joints, with findings for effects that are not simulated."""
    model = robot.model
    findings = robot.repairs
    # Motion of each joint over that of its leader: a follower has no motor.
    shares = np.eye(model.njnt)
    for _ in couplings:  # at most as many leaders of leaders
        for follower, (leader, multiplier, _offset) in couplings.items():
            shares[follower] = multiplier * shares[leader]
    joints = list(robot.joints)
    armature = np.zeros(model.njnt)
    armature[joints] = model.dof_armature[model.jnt_dofadr[joints]]
    armature = shares.T**2 @ armature
    limits, kp, kd = np.zeros((3, model.njnt))
    setpoints = np.outer([-np.inf, np.inf], np.ones(model.njnt))
    moments = _moments(robot)
    arms = moments @ shares
    for actuator, row in enumerate(arms):
        moved = np.flatnonzero(row).tolist()
        stiffness, damping = _gains(model, actuator) * (len(moved) == 1)
        is_read = len(moved) == 1 and _is_plain(model, actuator)
        if not is_read:
            text = f"actuator {label(model.actuator(actuator))} has effects that are not simulated"
            text += ": only motors and servos of one joint are"
            remedy = "check gains and limits of the joint"
            names = [robot.joints[joint] for joint in moved]
            findings += [Finding("actuator", text, remedy, name) for name in names or [None]]
        for joint in moved:
            force = _largest_force(model, actuator, robot.joints[joint], findings)
            limits[joint] += abs(row[joint]) * force
            armature[joint] += row[joint] ** 2 * np.ravel(model.actuator_armature[actuator])[0]
            kp[joint] += row[joint] ** 2 * stiffness
            kd[joint] += row[joint] ** 2 * damping
        # The range of a servo's setpoints, where it moves with one joint alone.
        alone = np.flatnonzero(moments[actuator]).tolist()
        control = int(model.actuator_ctrladr[actuator])
        if is_read and stiffness and len(alone) == 1 and model.actuator_ctrllimited[control]:
            gain = model.actuator_gainprm[actuator, 0] / stiffness
            ends = gain * model.actuator_ctrlrange[control]
            setpoints[:, alone[0]] = np.sort(ends / moments[actuator, alone[0]])
    unmoved = np.zeros(model.njnt, bool)
    for joint, name in robot.joints.items():
        if model.nu and not arms[:, joint].any() and joint not in couplings:
            text = (
                "no actuator of the file moves the joint: it is controlled like all others, without"
                " compensation of gravity and friction"
            )
            remedy = "give it gains of 0 to let it move freely, or a motor in the file"
            unmoved[joint] = True
            findings.append(Finding("actuator", text, remedy, name))
        # A limit of 0 counts as none.
        limits[joint] = limits[joint] or math.inf
        if model.jnt_actfrclimited[joint]:
            narrower = _magnitude(model.jnt_actfrcrange[joint], name, findings)
            limits[joint] = min(limits[joint], narrower)
    return JointMotors(
        limits,
        armature,
        kp,
        kd,
        setpoints,
        unmoved,
    )


def _moments(robot: RobotInFile) -> Float64:
    """Return the moment arms of the actuators on the joints (actuators, joints), 0 for an actuator
    that acts otherwise than by constant arms on joints of the robot.
    """
    model = robot.model
    joints = list(robot.joints)
    arms = np.zeros((len(model.actuator_trntype), model.njnt))
    for actuator, kind in enumerate(model.actuator_trntype.tolist()):
        # A tendon is fixed, and has constant arms, if joints are its parts.
        if kind == _TRN.mjTRN_TENDON:
            first = model.tendon_adr[model.actuator_trnid[actuator, 0]]
            is_constant = model.wrap_type[first] == mujoco.mjtWrap.mjWRAP_JOINT
        else:
            is_constant = kind in (_TRN.mjTRN_JOINT, _TRN.mjTRN_JOINTINPARENT)
        row = robot.moments[model.actuator_outadr[actuator]]
        of_joints = row[model.jnt_dofadr[joints]]
        if is_constant and np.count_nonzero(row) == np.count_nonzero(of_joints):
            arms[actuator, joints] = of_joints
    return arms


def _is_plain(model: MjModel, actuator: int) -> bool:
    """Return whether an actuator is a motor or a position servo without further effects."""
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


def _gains(model: MjModel, actuator: int) -> Float64:
    """Return stiffness and damping (2,) of an actuator; 0 for a motor and unknown laws."""
    # A plugin's parameters have other meanings.
    is_affine = model.actuator_biastype[actuator] == _BIAS.mjBIAS_AFFINE
    if model.actuator_plugin[actuator] >= 0 or not is_affine:
        return np.zeros(2)
    gains: Float64 = np.maximum(-model.actuator_biasprm[actuator, 1:3], 0.0)
    return gains


def _largest_force(model: MjModel, actuator: int, name: str, findings: list[Finding]) -> float:
    """Return the limit of the force of an actuator, which moves the joint ``name``."""
    low, high = -math.inf, math.inf
    if model.actuator_forcelimited[actuator]:
        low, high = model.actuator_forcerange[actuator].tolist()
    # The range of a servo's control is one of positions, not of forces.
    control = int(model.actuator_ctrladr[actuator])
    is_fixed = model.actuator_gaintype[actuator] == _GAIN.mjGAIN_FIXED
    is_force = is_fixed and int(model.actuator_dyntype[actuator]) in _FILTERS
    is_motor = not _gains(model, actuator).any()
    if is_motor and is_force and model.actuator_ctrllimited[control]:
        forces = float(model.actuator_gainprm[actuator, 0]) * model.actuator_ctrlrange[control]
        low = max(low, float(forces.min()))
        high = min(high, float(forces.max()))
    force = _magnitude((low, high), name, findings)
    tendon = int(model.actuator_trnid[actuator, 0])
    if model.actuator_trntype[actuator] == _TRN.mjTRN_TENDON and model.tendon_actfrclimited[tendon]:
        force = min(force, _magnitude(model.tendon_actfrcrange[tendon], name, findings))
    return force


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
