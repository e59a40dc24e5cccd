"""Calls into the engine for all robots of a pack: reads, efforts, and steps of their systems."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import DType, Rows


class EngineCalls(Protocol):
    """Reads and writes of M robots, as arrays (M, dof) in SAPIEN's order, SI units."""

    def qpos(self, dtype: DType) -> Rows:
        """Return the joint positions, a new array."""

    def qvel(self, dtype: DType) -> Rows:
        """Return the joint velocities, a new array."""

    def passive_force(self, gravity: bool, coriolis: bool, dtype: DType) -> Rows:
        """Return the efforts that cancel gravity and Coriolis and centrifugal forces, a new array."""

    def write_qf(self) -> None:
        """Apply the efforts in the array ``qf`` that the calls were made with, except to skipped robots."""

    def step(self) -> None:
        """Do one sim step of every system."""

    def close(self) -> None:
        """Release robots and systems, so that they can be freed; no other call follows."""


class PythonCalls:
    """One Python call for each robot and quantity. ``qf`` (M, dof) of float32; ``skip`` (M,): efforts are not applied.

    The native calls are tested against these.
    """

    def __init__(
        self, robots: Sequence[Any], systems: Sequence[Any], qf: NDArray[np.float32], skip: NDArray[np.bool_]
    ) -> None:
        # Bound methods and kept row views: looking them up, or slicing, costs as much as the calls.
        self._shape = qf.shape
        self._get_qpos = [robot.get_qpos for robot in robots]
        self._get_qvel = [robot.get_qvel for robot in robots]
        self._passive_force = [robot.compute_passive_force for robot in robots]
        rows = zip(robots, qf, skip, strict=True)
        self._set_qf = [(robot.set_qf, row) for robot, row, skipped in rows if not skipped]
        self._steps = [system.step for system in systems]

    def qpos(self, dtype: DType) -> Rows:
        """Return the joint positions, a new array."""
        return np.concatenate([get() for get in self._get_qpos], dtype=dtype).reshape(self._shape)

    def qvel(self, dtype: DType) -> Rows:
        """Return the joint velocities, a new array."""
        return np.concatenate([get() for get in self._get_qvel], dtype=dtype).reshape(self._shape)

    def passive_force(self, gravity: bool, coriolis: bool, dtype: DType) -> Rows:
        """Return the efforts that cancel gravity and Coriolis and centrifugal forces, a new array."""
        forces = [compute(gravity, coriolis) for compute in self._passive_force]
        return np.concatenate(forces, dtype=dtype).reshape(self._shape)

    def write_qf(self) -> None:
        """Apply the efforts in ``qf``."""
        for set_qf, row in self._set_qf:
            set_qf(row)

    def step(self) -> None:
        """Do one sim step of every system."""
        for step in self._steps:
            step()

    def close(self) -> None:
        """Release robots and systems."""
        self._get_qpos, self._get_qvel, self._passive_force, self._set_qf, self._steps = [], [], [], [], []
