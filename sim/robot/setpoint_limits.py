"""Limits of a robot's setpoints."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

import batchpid as bp
from batchpid.arrays.records import frozen
from batchpid.checks.validate import instance
from batchpid.errors import InvalidArgumentError
from batchpid.sim.robot.mimics import coupling_of
from batchpid.sim.robot.parts import Joint


def setpoint_guard(
    joints: Sequence[Joint], rate: ArrayLike | None, acceleration: ArrayLike | None
) -> bp.Guard:
    """Return the limits of setpoints of the degrees of freedom ``joints``, of the URDF where they
    are not given.

    Followers have none: their limits narrow the limits of their leaders.

    Raises InvalidArgumentError if a follower of a continuous joint has position limits.
    """
    fastest = [joint.velocity_limit if joint.velocity_limit > 0 else np.inf for joint in joints]
    limits = bp.make_guard(
        len(joints),
        lower=[max(joint.lower, joint.soft_lower) for joint in joints],
        upper=[min(joint.upper, joint.soft_upper) for joint in joints],
        rate=fastest if rate is None else rate,
        acceleration=acceleration,
        continuous=[joint.continuous for joint in joints],
        joint_names=[joint.name for joint in joints],
    )
    return _of_leaders(limits, joints)


def _of_leaders(guard: bp.Guard, joints: Sequence[Joint]) -> bp.Guard:
    """Return ``guard`` with limits of the leaders that hold for their followers, too, and none of
    the followers.

    Position limits of a follower that leave its leader no range are left out, as in a robot's own
    limits.
    """
    coupling = coupling_of(tuple(joints))
    if coupling.is_identity:  # its limits keep their shapes
        return guard
    shape = max((np.shape(leaf) for leaf in guard if leaf is not None), default=(1, len(joints)))
    free = guard._replace(lower=-np.inf, upper=np.inf, rate=np.inf, acceleration=np.inf)
    low, high, rate, acceleration = (
        np.broadcast_to(none if leaf is None else leaf, shape).astype(np.float64)
        for leaf, none in zip(guard[:4], free[:4], strict=True)
    )
    for index in coupling.followers.tolist():
        leader = int(coupling.leader[index])
        multiplier = float(coupling.multiplier[index])
        if multiplier == 0:
            continue
        for fastest in (rate, acceleration):
            fastest[:, leader] = np.minimum(fastest[:, leader], fastest[:, index] / abs(multiplier))
        ends = np.sort(
            [(end[:, index] - coupling.offset[index]) / multiplier for end in (low, high)], axis=0
        )
        # A leader that turns without end takes its follower anywhere.
        if joints[leader].continuous:
            _check_turning(joints[index].name, joints[leader].name, ends)
            continue
        ends = np.stack([np.maximum(low[:, leader], ends[0]), np.minimum(high[:, leader], ends[1])])
        # Limits that exclude each other would leave no setpoint.
        narrower = ends[0] < ends[1]
        low[:, leader], high[:, leader] = np.where(
            narrower, ends, (low[:, leader], high[:, leader])
        )
    for limits, none in zip((low, high, rate, acceleration), free, strict=False):
        limits[:, coupling.followers] = none
    leaves = dict(zip(guard._fields, (low, high, rate, acceleration), strict=False))
    return guard._replace(
        **{name: None if np.isinf(limits).all() else limits for name, limits in leaves.items()}
    )


def _check_turning(follower: str, leader: str, ends: NDArray[np.float64]) -> None:
    """Raise InvalidArgumentError for position limits ``ends`` of a follower of a continuous
    joint.
    """
    if np.isfinite(ends).any():
        problem = (
            f"cannot hold the position limits of {follower!r}, which follows the continuous joint"
        )
        remedy = (
            "make the leader revolute with limits, or pass batchpid.make_guard(...) without lower"
            " and upper"
        )
        raise InvalidArgumentError("guard", problem, joint=leader, remedy=remedy)


def fit_guard(
    guard: object, joints: Sequence[Joint], num_envs: int, control: str, sets_positions: bool
) -> bp.Guard | None:
    """Return the guard for a runner's option ``guard``; None means no guard.

    Raises InvalidArgumentError if it does not fit the robot or the control, or limits the positions
    of a follower of a continuous joint.
    """
    if guard is False or guard is None:
        return None
    if not sets_positions:
        problem = "limits positions of joints, which this control does not take"
        remedy = "use control 'pid' or 'drive'"
        raise InvalidArgumentError("guard", problem, value=control, remedy=remedy)
    limits = setpoint_guard(joints, None, None) if guard is True else guard
    limits = instance("guard", limits, bp.Guard, "pass True, or robot.guard(...)")
    limits.check(num_envs, [joint.name for joint in joints])
    return frozen(_of_leaders(limits, joints))
