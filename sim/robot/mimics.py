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
        # A follower without end holds nothing back.
        if joints[index].continuous:
            continue
        leader = int(coupling.leader[index])
        ends = (limits[leader], _on_leader(coupling, index, joints[index]))
        low = max(low for low, _ in ends)
        high = min(high for _, high in ends)
        if low < high:
            limits[leader] = (low, high)
    # After all leaders are narrowed, followers get the images of their limits.
    for index in coupling.followers.tolist():
        multiplier = float(coupling.multiplier[index])
        offset = float(coupling.offset[index])
        images = [multiplier * end + offset for end in limits[coupling.leader[index]]]
        limits[index] = (min(images), max(images))
    share = np.abs(coupling.multiplier)
    friction, damping = np.zeros((2, len(joints)))
    np.add.at(friction, coupling.leader, share * [joint.friction for joint in joints])
    np.add.at(
        damping,
        coupling.leader,
        share**2 * [joint.damping for joint in joints],
    )
    coupled = []
    for index, joint in enumerate(joints):
        low, high = limits[index]
        rubs = float(friction[index])
        damps = float(damping[index])
        coupled.append(replace(joint, lower=low, upper=high, friction=rubs, damping=damps))
    return tuple(coupled)


def _on_leader(coupling: Coupling, index: int, joint: Joint) -> tuple[float, float]:
    """Return the positions of the leader at the limits of its follower ``joint``."""
    offset = float(coupling.offset[index])
    multiplier = float(coupling.multiplier[index])
    ends = [(end - offset) / multiplier for end in (joint.lower, joint.upper)]
    return min(ends), max(ends)
