r"""Constraint efforts of coupled joints: followers move with their leaders, and the leaders feel them.

With the constraint c = q_f - m q_l - o = 0 of every follower, J its Jacobian, and efforts u, the joints get
qf = u + J^T lambda, where::

    J M^-1 J^T lambda = -(J M^-1 (u - p) + 0.5 c' / dt + 0.25 c / dt^2)

p is the passive force. lambda does no work on the motion of the independent joints, J G = 0, so that exactly their
coupled dynamics remain. The last two terms bring c back to zero within a few steps (J. Baumgarte, "Stabilization of
constraints and integrals of motion in dynamical systems", Computer Methods in Applied Mechanics and Engineering 1,
1972): their poles are at |z| = 0.71, and stay stable up to three times these gains, when M is that much off. A force F
on the follower alone, as of an object, displaces it by 4 F dt^2 (J M^-1 J^T).

PhysX's fixed tendons, which SAPIEN takes for this, hold one follower, but several followers of one leader shake a whole
arm, or make it diverge. See docs/joints.md.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Float64
from batchpid.arrays.elementwise import TURN, multiply
from batchpid.motors.coupling import Coupling

RATE_GAIN, POSITION_GAIN = 0.5, 0.25
"""Gains of c' dt and c in units of 1 / dt^2."""


class ConstraintEfforts:
    """Constraint efforts of robots with the coupling ``coupling``; ``continuous`` (dof,) positions wrap.

    Arrays are (robots, dof). :meth:`update` comes before the first :meth:`apply`.
    """

    def __init__(self, coupling: Coupling, continuous: NDArray[np.bool_], timestep: float) -> None:
        self._coupling, self._wraps = coupling, continuous[coupling.followers]
        self._rate_gain, self._position_gain = RATE_GAIN / timestep, POSITION_GAIN / timestep**2

    def update(self, mass_matrix: Float64, passive: Float64) -> None:
        """Set mass matrix (robots, dof, dof) and passive force; they may be some steps old."""
        sound = np.isfinite(mass_matrix).all((1, 2), keepdims=True)  # a robot may have failed
        inverse = np.linalg.inv(np.where(sound, mass_matrix, np.eye(mass_matrix.shape[1])))
        jacobian = self._coupling.jacobian
        response = jacobian @ inverse
        self._response, self._passive = response, passive
        self._effort = jacobian.T @ np.linalg.inv(response @ jacobian.T)

    def apply(self, effort: NDArray[np.floating], qpos: Float64, qvel: Float64) -> Float64:
        """Return ``effort`` with the constraint efforts added."""
        coupling, followers = self._coupling, self._coupling.followers
        error = (qpos - coupling.positions(qpos))[:, followers]
        error = np.where(self._wraps, error - TURN * np.rint(error / TURN), error)
        rate = (qvel - coupling.rates(qvel))[:, followers]
        wrong = multiply(self._response, effort - self._passive)
        wrong += self._rate_gain * rate + self._position_gain * error
        return effort - multiply(self._effort, wrong)
