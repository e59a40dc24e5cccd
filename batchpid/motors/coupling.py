r"""Coupling of joints: followers, such as the mimic joints of a gripper, that move with their
leaders.

A follower i has the position q_i = m_i q_l + o_i, where l is its leader, so that the robot moves
only as its independent joints q_r do::

    q = G q_r + o        q' = G q_r'        u_r = G^T u        M_r = G^T M G

R. Featherstone, Rigid Body Dynamics Algorithms (Springer, 2008), section 3.2. An effort on a
follower acts through the coupling on its leader, multiplied by m_i.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import wraps
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Array, Float64, Rows
from batchpid.arrays.elementwise import namespace, read_only, take_columns


class Follower(NamedTuple):
    """Joint ``joint`` that moves as ``multiplier * q_leader + offset``; joints are indices."""

    joint: int
    leader: int
    multiplier: float = 1.0
    offset: float = 0.0


class Share(NamedTuple):
    """Followers of the leaders, at most one for each leader; arrays (joints,)."""

    exists: Array
    """Whether the joint has this follower."""
    joint: Array
    """Index of the follower, 0 without it."""
    multiplier: Array


def _of_followers(method: Callable[[Coupling, Any], Any]) -> Callable[[Coupling, Any], Any]:
    """Return a method that returns its argument if no joint follows."""

    @wraps(method)
    def call(self: Coupling, given: Array) -> Array:
        if self.shares:
            return method(self, given)
        return given

    return call


class Coupling(NamedTuple):
    """Coupling of a robot's joints; the identity if no joint follows. Arrays are (joints,), and
    read-only.

    Methods take and return arrays (..., joints) unless said otherwise, of NumPy or JAX, or symbols
    of a trace. For the identity they return their argument.
    """

    leader: Array
    """Index of the independent joint that each joint moves with: its own index if it is
    independent.
    """
    multiplier: Array
    """Multiplier in ``q = multiplier * q[leader] + offset``: 1 for an independent joint."""
    offset: Array
    """Offset there: 0 for an independent joint."""
    independent: Array
    """True for the joints that are not followers."""
    shares: tuple[Share, ...] = ()
    """The first followers of all leaders, the second ones, and so on."""

    @classmethod
    def of(cls, joints: int, followers: Sequence[Follower] = ()) -> Coupling:
        """Return the coupling of ``followers``, one entry for each; a chain of followers ends at
        its last leader.

        Raises ValueError if a joint follows itself, through others or directly.
        """
        leaders = np.arange(joints)
        multipliers = np.ones(joints)
        offsets = np.zeros(joints)
        independent = np.ones(joints, bool)
        for follower in followers:
            leaders[follower.joint] = follower.leader
            multipliers[follower.joint] = follower.multiplier
            offsets[follower.joint] = follower.offset
            independent[follower.joint] = False
        # Chains of followers are multiplied out, one link of each at a time, down to their leaders.
        direct = leaders, multipliers, offsets
        for _ in range(joints):
            if independent[leaders].all():
                break
            offsets = offsets + multipliers * direct[2][leaders]
            multipliers = multipliers * direct[1][leaders]
            leaders = direct[0][leaders]
        else:
            raise ValueError(f"joint {np.argmin(independent[leaders])} follows itself")
        # Sums over followers have a fixed order: the first of each leader, then the second.
        shares = list[Share]()
        counts = np.zeros(joints, int)
        for joint in np.flatnonzero(~independent):
            leader = leaders[joint]
            if counts[leader] == len(shares):
                shares.append(
                    Share(np.zeros(joints, bool), np.zeros(joints, int), np.zeros(joints))
                )
            share = shares[counts[leader]]
            counts[leader] += 1
            share.exists[leader] = True
            share.joint[leader] = joint
            share.multiplier[leader] = multipliers[joint]
        arrays = map(read_only, (leaders, multipliers, offsets, independent))
        return cls._make((*arrays, tuple(Share(*map(read_only, share)) for share in shares)))

    @property
    def is_identity(self) -> bool:
        """Whether all joints are independent; also known in a trace."""
        return not self.shares

    @property
    def followers(self) -> NDArray[np.intp]:
        """Indices of the followers (followers,)."""
        return read_only(np.flatnonzero(~self.independent))

    @property
    def matrix(self) -> Float64:
        """G (joints, independent joints)."""
        matrix = np.zeros((len(self.leader), len(self.leader)))
        matrix[np.arange(len(self.leader)), self.leader] = self.multiplier
        return read_only(matrix[:, self.independent])

    @property
    def jacobian(self) -> Float64:
        """J (followers, joints) of the constraint J q = o of every follower, q_f - m q_l = o."""
        whole = np.eye(len(self.leader))
        whole[np.arange(len(self.leader)), self.leader] -= self.multiplier
        return read_only(whole[self.followers])

    @_of_followers
    def positions(self, qpos: Array) -> Array:
        """Return ``qpos`` with the followers moved to match their leaders."""
        return self.rates(qpos) + self.offset

    @_of_followers
    def rates(self, qvel: Array) -> Array:
        """Return ``qvel`` with the rates of followers computed from their leaders'."""
        return self.multiplier * self.of_leaders(qvel)

    @_of_followers
    def efforts(self, effort: Array) -> Array:
        """Return the efforts G^T u on the independent joints for u = ``effort``; zero for
        followers.
        """
        xp = namespace(effort)
        acting = self.of_independent(effort)
        for share in self.shares:  # the order of the sum is the same for any number of rows
            added = share.multiplier * take_columns(effort, share.joint)
            acting = xp.where(share.exists, acting + added, acting)
        return acting

    @_of_followers
    def of_independent(self, figures: Array) -> Array:
        """Return ``figures`` with 0 for followers."""
        return namespace(figures).where(self.independent, figures, 0.0)

    @_of_followers
    def of_leaders(self, figures: Array) -> Array:
        """Return ``figures`` in which followers take the figures of their leaders."""
        return take_columns(figures, self.leader)

    @_of_followers
    def of_all(self, figures: Array) -> Array:
        """Return ``figures`` (..., independent) for all joints (..., joints); followers have their
        leaders' values.
        """
        return figures[..., (np.cumsum(self.independent) - 1)[self.leader]]

    @_of_followers
    def mass_matrix(self, matrix: Array) -> Array:
        """Return G^T M G for M (..., joints, joints) in the rows and columns of the independent
        joints.

        Rows and columns of followers are rows and columns of the identity. ``fold`` in rigid_body.h
        is the same.
        """
        xp = namespace(matrix)
        rows = xp.swapaxes(
            self.efforts(xp.swapaxes(matrix, -1, -2)),
            -1,
            -2,
        )
        return self.efforts(rows) + xp.diag(
            xp.where(self.independent, 0.0, 1.0).astype(matrix.dtype)
        )

    @_of_followers
    def reduced(self, matrix: Array) -> Array:
        """Return M_r = G^T M G (..., independent, independent) of a mass matrix M (..., joints,
        joints).
        """
        return self.mass_matrix(matrix)[..., self.independent, :][..., self.independent]

    @_of_followers
    def reduced_damping(self, damping: Array) -> Array:
        """Return the diagonal of G^T B G (independent,) for viscous damping B = diag(damping)
        (joints,).
        """
        return self.matrix.T**2 @ damping

    def native(self) -> dict[str, Rows]:
        """Return the arrays for Coupling in rigid_body.h; none for the identity."""
        if self.is_identity:
            return {}
        return {"leader": self.leader.astype(np.int32), "multiplier": np.array(self.multiplier)}
