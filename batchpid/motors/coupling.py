r"""Coupling of joints: followers, such as the mimic joints of a gripper, that move with their leaders.

A follower i has the position q_i = m_i q_l + o_i, where l is its leader, so that the robot moves only as its
independent joints q_r do::

    q = G q_r + o        q' = G q_r'        u_r = G^T u        M_r = G^T M G

R. Featherstone, Rigid Body Dynamics Algorithms (Springer, 2008), section 3.2. An effort on a follower acts through the
coupling on its leader, multiplied by m_i.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from batchpid.arrays.array_types import Float64
from batchpid.arrays.elementwise import namespace
from batchpid.arrays.read_only import read_only


class Follower(NamedTuple):
    """Joint ``joint`` that moves as ``multiplier * q_leader + offset``; joints are indices."""

    joint: int
    leader: int
    multiplier: float = 1.0
    offset: float = 0.0


class Share(NamedTuple):
    """Followers of the leaders, one of each leader at most; arrays (joints,)."""

    exists: Any
    """Whether the joint has this follower."""
    joint: Any
    """Index of the follower, 0 without it."""
    multiplier: Any


class CouplingArrays(NamedTuple):
    """Arrays of a :class:`Coupling` (joints,), for functions of NumPy arrays, or of symbols in a trace."""

    leader: Any
    multiplier: Any
    offset: Any
    independent: Any
    shares: tuple[Share, ...]
    """The first followers of all leaders, the second ones, and so on."""

    def positions(self, qpos: Any) -> Any:
        """Return ``qpos`` (..., joints) with the followers where their leaders have them."""
        return self.rates(qpos) + self.offset

    def rates(self, qvel: Any) -> Any:
        """Return ``qvel`` (..., joints) with the rates that the followers have by their leaders'."""
        return self.multiplier * self.of_leaders(qvel)

    def efforts(self, effort: Any) -> Any:
        """Return the efforts G^T u on the independent joints for u (..., joints); zero for followers."""
        xp = namespace(effort)
        acting = xp.where(self.independent, effort, 0.0)
        for share in self.shares:  # the order of the sum is the same for any number of rows
            added = share.multiplier * xp.take(effort, share.joint, axis=-1)
            acting = xp.where(share.exists, acting + added, acting)
        return acting

    def of_leaders(self, figures: Any) -> Any:
        """Return ``figures`` (..., joints) in which followers take the figures of their leaders."""
        return namespace(figures).take(figures, self.leader, axis=-1)

    def mass_matrix(self, matrix: Any) -> Any:
        """Return G^T M G for M (..., joints, joints) in the rows and columns of the independent joints.

        Rows and columns of followers are the identity's. ``fold`` in coupling.h is the same function.
        """
        xp = namespace(matrix)
        rows = xp.swapaxes(self.efforts(xp.swapaxes(matrix, -1, -2)), -1, -2)
        return self.efforts(rows) + xp.diag(xp.where(self.independent, 0.0, 1.0).astype(matrix.dtype))


class Coupling:
    """Coupling of a robot's joints. Arrays are (joints,) unless said otherwise, and read-only.

    Attributes
    ----------
    leader
        Index of the independent joint that each joint moves with: its own index if it is independent.
    multiplier, offset
        ``q = multiplier * q[leader] + offset``: 1 and 0 for an independent joint.
    independent
        True for the joints that are not followers.
    """

    def __init__(self, joints: int, followers: Sequence[Follower]) -> None:
        """Couple ``followers``, one entry for each; a chain of followers ends at its last leader.

        Raises ValueError if a joint follows itself, through others or directly.
        """
        self.leader, self.multiplier, self.offset = np.arange(joints), np.ones(joints), np.zeros(joints)
        self.independent = np.ones(joints, bool)
        direct = {follower.joint: follower for follower in followers}
        for joint in direct:
            multiplier, offset, leader, passed = 1.0, 0.0, joint, set[int]()
            while leader in direct:
                if leader in passed:
                    raise ValueError(f"joint {joint} follows itself")
                passed.add(leader)
                _, leader, factor, shift = direct[leader]
                multiplier, offset = multiplier * factor, offset + multiplier * shift
            self.leader[joint], self.multiplier[joint], self.offset[joint] = leader, multiplier, offset
            self.independent[joint] = False
        for name, array in vars(self).items():
            vars(self)[name] = read_only(array)

    @cached_property
    def arrays(self) -> CouplingArrays:
        """Arrays of the coupling, for a control step."""
        shares = list[Share]()
        of_leader = [self.followers[self.leader[self.followers] == joint] for joint in range(len(self.leader))]
        for number in range(max(map(len, of_leader), default=0)):
            exists = np.array([len(followers) > number for followers in of_leader])
            joint = np.array([followers[number] if len(followers) > number else 0 for followers in of_leader])
            shares.append(Share(*map(read_only, (exists, joint, np.where(exists, self.multiplier[joint], 0.0)))))
        return CouplingArrays(self.leader, self.multiplier, self.offset, self.independent, tuple(shares))

    @cached_property
    def matrix(self) -> Float64:
        """G (joints, independent joints)."""
        matrix = np.zeros((len(self.leader), len(self.leader)))
        matrix[np.arange(len(self.leader)), self.leader] = self.multiplier
        return read_only(matrix[:, self.independent])

    @cached_property
    def jacobian(self) -> Float64:
        """J (followers, joints) of the constraint J q = o of every follower, q_f - m q_l = o."""
        whole = np.eye(len(self.leader))
        whole[np.arange(len(self.leader)), self.leader] -= self.multiplier
        return read_only(whole[self.followers])

    @cached_property
    def followers(self) -> NDArray[np.intp]:
        """Indices of the followers (followers,)."""
        return read_only(np.flatnonzero(~self.independent))

    def positions(self, qpos: ArrayLike) -> Float64:
        """Return ``qpos`` (..., joints) with the followers where their leaders have them."""
        return self.arrays.positions(np.asarray(qpos, np.float64))

    def rates(self, qvel: ArrayLike) -> Float64:
        """Return ``qvel`` (..., joints) with the rates that the followers have by their leaders'."""
        return self.arrays.rates(np.asarray(qvel, np.float64))

    def efforts(self, effort: ArrayLike) -> Float64:
        """Return the efforts G^T u on the independent joints for u (..., joints); zero for followers."""
        return self.arrays.efforts(np.asarray(effort, np.float64))

    def reduced(self, mass_matrix: ArrayLike) -> Float64:
        """Return M_r (..., independent, independent) of a mass matrix M (..., joints, joints)."""
        return self.mass_matrix(mass_matrix)[..., self.independent, :][..., self.independent]

    def mass_matrix(self, mass_matrix: ArrayLike) -> Float64:
        """Return M_r in the rows and columns of the independent joints (..., joints, joints), else the identity."""
        reduced: Float64 = self.arrays.mass_matrix(np.asarray(mass_matrix, np.float64))
        return reduced

    def reduced_damping(self, damping: ArrayLike) -> Float64:
        """Return the diagonal of G^T B G (independent,) for viscous damping B = diag(damping) (joints,)."""
        return self.matrix.T**2 @ np.asarray(damping, np.float64)

    def of_all(self, figures: ArrayLike) -> NDArray[Any]:
        """Return ``figures`` (..., independent) for all joints (..., joints); followers have their leaders' values."""
        return np.asarray(figures)[..., (np.cumsum(self.independent) - 1)[self.leader]]

    def of_leaders(self, figures: ArrayLike) -> NDArray[Any]:
        """Return ``figures`` (..., joints) in which followers take the figures of their leaders."""
        return np.asarray(self.arrays.of_leaders(np.asarray(figures)))

    def __repr__(self) -> str:
        laws = (f"q{i} = {self.multiplier[i]:g} q{self.leader[i]} + {self.offset[i]:g}" for i in self.followers)
        return f"Coupling({len(self.leader)} joints: {', '.join(laws)})"
