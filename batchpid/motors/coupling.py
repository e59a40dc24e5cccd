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
from batchpid.arrays.read_only import read_only


class Follower(NamedTuple):
    """Joint ``joint`` that moves as ``multiplier * q_leader + offset``; joints are indices."""

    joint: int
    leader: int
    multiplier: float = 1.0
    offset: float = 0.0


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
        return self.multiplier * np.asarray(qpos, np.float64)[..., self.leader] + self.offset

    def rates(self, qvel: ArrayLike) -> Float64:
        """Return ``qvel`` (..., joints) with the rates that the followers have by their leaders'."""
        return self.multiplier * np.asarray(qvel, np.float64)[..., self.leader]

    def efforts(self, effort: ArrayLike) -> Float64:
        """Return the efforts G^T u on the independent joints for u (..., joints); zero for followers."""
        given = np.asarray(effort, np.float64)
        acting = np.where(self.independent, given, 0.0)
        for joint in self.followers:  # element by element: the order of the sum is the same for any number of rows
            acting[..., self.leader[joint]] += self.multiplier[joint] * given[..., joint]
        return acting

    def reduced(self, mass_matrix: ArrayLike) -> Float64:
        """Return M_r (..., independent, independent) of a mass matrix M (..., joints, joints)."""
        return self.matrix.T @ np.asarray(mass_matrix, np.float64) @ self.matrix

    def mass_matrix(self, mass_matrix: ArrayLike) -> Float64:
        """Return M_r in the rows and columns of the independent joints (..., joints, joints), else the identity."""
        reduced = self.reduced(mass_matrix)
        joints, free = len(self.leader), np.flatnonzero(self.independent)
        whole = np.tile(np.eye(joints), (*reduced.shape[:-2], 1, 1))
        whole[..., free[:, None], free] = reduced
        return whole

    def reduced_damping(self, damping: ArrayLike) -> Float64:
        """Return the diagonal of G^T B G (independent,) for viscous damping B = diag(damping) (joints,)."""
        return self.matrix.T**2 @ np.asarray(damping, np.float64)

    def of_all(self, figures: ArrayLike) -> NDArray[Any]:
        """Return ``figures`` (..., independent) for all joints (..., joints); followers have their leaders' values."""
        return np.asarray(figures)[..., (np.cumsum(self.independent) - 1)[self.leader]]

    def of_leaders(self, figures: ArrayLike) -> NDArray[Any]:
        """Return ``figures`` (..., joints) in which followers take the figures of their leaders."""
        return np.asarray(figures)[..., self.leader]

    def __repr__(self) -> str:
        laws = (f"q{i} = {self.multiplier[i]:g} q{self.leader[i]} + {self.offset[i]:g}" for i in self.followers)
        return f"Coupling({len(self.leader)} joints: {', '.join(laws)})"
