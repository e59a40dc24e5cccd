"""Mimic joints of a URDF as a coupling of its degrees of freedom."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np

from batchpid.motors.coupling import Coupling, Follower
from batchpid.sim.robot.parts import Joint


@lru_cache(maxsize=32)
def coupling_of(joints: tuple[Joint, ...]) -> Coupling:
    """Return the coupling of the degrees of freedom ``joints``; the identity without mimic
    joints.
    """
    indices = {joint.name: index for index, joint in enumerate(joints)}
    followers = [
        Follower(index, indices[joint.mimic.joint], joint.mimic.multiplier, joint.mimic.offset)
        for index, joint in enumerate(joints)
        if joint.mimic is not None
    ]
    return Coupling.of(len(joints), followers)


def couple(joints: Sequence[Joint]) -> tuple[Joint, ...]:
    """Return ``joints`` with the leaders' limits, friction and damping adapted to their followers.

    A follower's position limits narrow the leader's, unless that would leave no range; the follower
    then gets the leader's limits, multiplied. Its friction and damping act on the leader as |m| F
    and m^2 B, which is equivalent in the coupled motion.
    """
    joints = tuple(joints)
    coupling = coupling_of(joints)
    limits = [(joint.lower, joint.upper) for joint in joints]
    for index in coupling.followers.tolist():
        leader, multiplier, offset = (
            column[index] for column in (coupling.leader, coupling.multiplier, coupling.offset)
        )
        # Such a follower holds nothing back.
        if multiplier == 0 or joints[index].continuous:
            continue
        ends = sorted(
            (end - offset) / multiplier for end in (joints[index].lower, joints[index].upper)
        )
        low = max(limits[leader][0], ends[0])
        high = min(limits[leader][1], ends[1])
        if low < high:
            limits[leader] = (float(low), float(high))
    # After all leaders are narrowed, followers get the images of their limits.
    for index in coupling.followers.tolist():
        ends = [_image(coupling, index, end) for end in limits[coupling.leader[index]]]
        limits[index] = (min(ends), max(ends))
    share = np.abs(coupling.multiplier)
    friction, damping = np.zeros((2, len(joints)))
    np.add.at(friction, coupling.leader, share * [joint.friction for joint in joints])
    np.add.at(damping, coupling.leader, share**2 * [joint.damping for joint in joints])
    return tuple(
        replace(joint, lower=low, upper=high, friction=float(rubs), damping=float(damps))
        for joint, (low, high), rubs, damps in zip(joints, limits, friction, damping, strict=True)
    )


def _image(coupling: Coupling, index: int, end: float) -> float:
    """Return the position of follower ``index`` where its leader is at ``end``, which may be
    infinite.
    """
    multiplier = float(coupling.multiplier[index])
    offset = float(coupling.offset[index])
    if multiplier == 0:
        return offset
    return multiplier * end + offset
