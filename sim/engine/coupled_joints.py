r"""Constraint efforts of coupled joints: followers move with their leaders, and the leaders feel
them.

With the constraint c = q_f - m q_l - o = 0 of every follower, J its Jacobian, and efforts u, the
joints get qf = u + J^T lambda, where::

    J M^-1 J^T lambda = -(J M^-1 (u - p) + 0.5 c' / dt + 0.25 c / dt^2)

p is the passive force. lambda does no work on the motion of the independent joints, J G = 0, so
that exactly their coupled dynamics remain. The last two terms bring c back to zero within a few
steps (J. Baumgarte, "Stabilization of constraints and integrals of motion in dynamical systems",
Computer Methods in Applied Mechanics and Engineering 1, 1972): their poles are at |z| = 0.71, and
stay stable up to three times these gains, when M is that much off. A force F on the follower alone,
as of an object, displaces it by 4 F dt^2 (J M^-1 J^T).

SAPIEN's positions of continuous joints jump from one end of [-2 pi, 2 pi] to the other, which would
move a follower by 4 pi m. So the constraint counts the jumps: it takes the position nearest to the
one in the sim step before.

PhysX's fixed tendons, which SAPIEN takes for this, hold one follower, but several followers of one
leader shake a whole arm, or make it diverge. See docs/joints.md.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Bool, Float32, Float64, Rows
from batchpid.arrays.elementwise import TURN, matrix_vector
from batchpid.motors.coupling import Coupling
from batchpid.sim.engine import native
from batchpid.sim.engine.native import structure
from batchpid.sim.engine.native_model import NativeModel, TreeModel

RATE_GAIN, POSITION_GAIN = 0.5, 0.25
"""Gains of c' dt and c in units of 1 / dt^2."""
WRAP = 2 * TURN
"""Size of a jump in SAPIEN's positions of continuous joints [rad]."""


class ConstraintEfforts:
    """Constraint efforts of robots with the coupling ``coupling``; positions of the joints
    ``wraps`` (dof,) jump.

    Arrays are (robots, dof). :meth:`update` comes before the first :meth:`apply`. Mass matrices are
    those of ``model``. Native code applies and updates the efforts by the structure at
    :attr:`address`, within a tick too, with passive forces of ``force``, or with the engine's for
    None; it writes the efforts without the constraint's into ``asked``, if given. Where positions
    jump, call :meth:`place` after every reset of positions.

    Attributes
    ----------
    wraps
        Mask of the joints whose positions jump (dof,).
    unwrapped
        Positions in the last sim step, without jumps (robots, dof); not used for other joints.
    implicit
        Inertia on the diagonal of the mass matrix besides the model's: armature of the motors, and
        damping times dt.
    """

    def __init__(
        self,
        robots: int,
        coupling: Coupling,
        wraps: Bool,
        timestep: float,
        model: TreeModel,
        force: TreeModel | None,
        asked: Float32 | None = None,
    ) -> None:
        joints = len(coupling.leader)
        followers = coupling.followers
        self._coupling = coupling
        self._followers = followers
        self._jacobian = coupling.jacobian
        self.wraps, self.unwrapped = wraps, np.zeros((robots, joints))
        self._rate_gain = RATE_GAIN / timestep
        self._position_gain = POSITION_GAIN / timestep**2
        self._response = np.zeros((robots, len(followers), joints))
        self._push, self._passive = (
            np.zeros((robots, joints, len(followers))),
            np.zeros((robots, joints)),
        )
        self.implicit = np.zeros((robots, joints))
        self._model = model
        arrays: dict[str, Rows] = {
            "response": self._response,
            "push": self._push,
            "passive": self._passive,
            "implicit": self.implicit,
            "followers": followers.astype(np.int64),
            "leaders": coupling.leader[followers].astype(np.int64),
            "multiplier": coupling.multiplier[followers],
            "offset": coupling.offset[followers],
            "wraps": wraps,
            "unwrapped": self.unwrapped,
            "wrong": np.zeros(len(followers)),
            "free": np.zeros(joints),
        } | ({} if asked is None else {"asked": asked})
        self._native = structure("Constraint")(
            rate_gain=self._rate_gain,
            position_gain=self._position_gain,
            size=len(followers),
            **{name: array.ctypes.data for name, array in arrays.items()},
        )
        if isinstance(model, NativeModel):
            self._native.model = model.address
        if isinstance(force, NativeModel):
            self._native.force = force.address
        self._kept = arrays, force

    @property
    def address(self) -> int:
        """Address of the constraint, for a group of the extension."""
        return ctypes.addressof(self._native)

    def update(self, qpos: Float64, passive: Float64, rows: Sequence[int] | slice) -> None:
        """Set mass matrix and passive force of robots ``rows``, at positions and passive forces of
        all robots.
        """
        if isinstance(self._model, NativeModel):
            mask = np.zeros(len(qpos), bool)
            mask[rows] = True
            arrays = (np.ascontiguousarray(table, np.float64) for table in (qpos, passive))
            native.extension("_gateway").update_constraint(self.address, *arrays, mask, len(qpos))
            return
        matrices = (self._model.mass_matrix(qpos) + self.implicit[:, None] * np.eye(qpos.shape[1]))[
            rows
        ]
        numbers = np.concatenate([matrices, passive[rows][:, :, None]], axis=2)
        sound = np.isfinite(numbers).all((1, 2), keepdims=True)  # a robot may have failed
        matrix = np.where(sound, matrices, np.eye(qpos.shape[1]))
        jacobian = self._jacobian
        response = np.linalg.solve(matrix, jacobian.T).swapaxes(1, 2)
        self._response[rows], self._passive[rows] = (
            response,
            np.where(sound[:, 0], passive[rows], 0.0),
        )
        # Once for all sim steps until the next update: each then takes two small products.
        self._push[rows] = jacobian.T @ np.linalg.inv(response @ jacobian.T)

    def place(self, rows: Sequence[int], qpos: Rows) -> None:
        """Put robots ``rows`` at positions ``qpos`` (len(rows), dof)."""
        self.unwrapped[rows] = qpos

    def apply(self, effort: NDArray[np.floating], qpos: Float64, qvel: Float64) -> Float64:
        """Return ``effort`` with the constraint efforts added."""
        coupling = self._coupling
        followers = self._followers
        # Of all positions that differ by whole jumps, that nearest to the last one.
        self.unwrapped[...] = np.where(
            self.wraps, qpos + WRAP * np.rint((self.unwrapped - qpos) / WRAP), qpos
        )
        error = (self.unwrapped - coupling.positions(self.unwrapped))[:, followers]
        rate = (qvel - coupling.rates(qvel))[:, followers]
        wrong = matrix_vector(self._response, effort - self._passive)
        wrong += self._rate_gain * rate + self._position_gain * error
        passed: Float64 = effort - matrix_vector(self._push, wrong)
        return passed
