r"""Mass matrix and bias of many robots by MuJoCo, in double precision, without contact, friction and motors.

On a floating base the joints show the Schur complements by the base's six degrees of freedom (b; j are the joints)::

    M = M_jj - M_jb M_bb^-1 M_bj        h = h_j - M_jb M_bb^-1 h_b

so that efforts h keep the joints from accelerating while the base falls freely.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import mujoco
import mujoco.batch
import numpy as np
from numpy.typing import NDArray

from batchpid.sim.engine.mujoco.model_builder import RobotMj, principal_inertia
from batchpid.task_space.spatial_inertia import SpatialInertia

Float64 = NDArray[np.float64]
FLOATING = 6
"""Degrees of freedom of a floating base, which come first in MuJoCo's arrays."""


class BatchModel:
    """Dynamics of ``size`` robots, of ``models`` that differ in their masses. Arrays are (size, dof)."""

    def __init__(self, robot: RobotMj, size: int, models: Sequence[Any] | None = None) -> None:
        model = _free(robot.model)
        self.batch = mujoco.batch.Batch(model, size, nthread=1)
        if models is not None:
            self.batch.set_models([_free(each) for each in models])
        self._robot, self._floats = robot, model.nv > len(robot.qvel)
        self._qpos, self._qvel, self._bias = (self.batch.bind(name) for name in ("qpos", "qvel", "qfrc_bias"))
        self._sparse = self.batch.bind("M")  # lower triangle, by rows
        self._rows = np.repeat(np.arange(model.nv), model.M_rownnz)
        self._columns = np.array(model.M_colind)

    def compute(self, qpos: Any, qvel: Any = 0.0, base: tuple[Float64, Float64] | None = None) -> None:
        """Compute at positions and velocities, on a base at the origin or in the state ``base`` (M, 7), (M, 6)."""
        self._qpos[:, self._robot.qpos], self._qvel[...] = qpos, 0.0
        self._qvel[:, self._robot.qvel] = qvel
        if self._floats:
            origin = (np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]), np.zeros(FLOATING))
            self._qpos[:, : FLOATING + 1], self._qvel[:, :FLOATING] = origin if base is None else base
        self.batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL)

    def mass_matrix(self) -> Float64:
        """Return the mass matrices of the joints (size, dof, dof) [kg m^2 or kg], with the base held."""
        return self._full()[:, self._robot.qvel[:, None], self._robot.qvel]

    def bias(self) -> Float64:
        """Return gravity, Coriolis and centrifugal efforts (size, dof) [N m or N], with the base held."""
        return self._bias[:, self._robot.qvel]

    def joint_mass_matrix(self) -> Float64:
        """Return the mass matrices that the joints show (size, dof, dof) [kg m^2 or kg]."""
        if not self._floats:
            return self.mass_matrix()
        full, joints = self._full(), self._robot.qvel
        own = full[:, joints[:, None], joints]
        couples = full[:, :FLOATING, joints]
        return own - couples.transpose(0, 2, 1) @ np.linalg.solve(full[:, :FLOATING, :FLOATING], couples)

    def joint_bias(self) -> Float64:
        """Return gravity, Coriolis and centrifugal efforts that the joints show (size, dof) [N m or N]."""
        if not self._floats:
            return self.bias()
        full, joints = self._full(), self._robot.qvel
        falling = np.linalg.solve(full[:, :FLOATING, :FLOATING], self._bias[:, :FLOATING, None])
        return self._bias[:, joints] - (full[:, joints, :FLOATING] @ falling)[..., 0]

    def _full(self) -> Float64:
        full = np.zeros((len(self._sparse), self.batch.qvel.shape[1], self.batch.qvel.shape[1]))
        full[:, self._rows, self._columns] = full[:, self._columns, self._rows] = self._sparse
        return full


def _free(model: Any) -> Any:
    """Return a copy of ``model`` without contact, constraints and motors."""
    free = copy.copy(model)
    free.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    free.dof_armature[:] = 0.0
    return free


def set_inertia(model: Any, body: int, inertia: SpatialInertia) -> None:
    """Give a body of a ``mujoco.MjModel`` this inertia, in the frame of the body; ``mj_setConst`` comes next."""
    moments, wxyz = principal_inertia(inertia)
    model.body_mass[body], model.body_ipos[body] = inertia.mass, inertia.center
    model.body_iquat[body], model.body_inertia[body] = wxyz, moments
    # Without the compiler's shortcuts for centers of mass at the body's origin, and bodies that are moved by one joint.
    model.body_sameframe[body], model.body_simple[body] = 0, 0
    model.dof_simplenum[:] = 0
