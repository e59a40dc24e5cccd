"""Operational-space control of a group of envs as a native call on fixed arrays, within the sim steps of a tick."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Array, Float64
from batchpid.task_space import native_law
from batchpid.task_space.osc_coefficients import OSCCoefficients


class BoundOSC:
    """The law of :class:`batchpid.sim.OperationalSpace` as a native call on fixed arrays.

    Attributes
    ----------
    state
        Arrays of the state by name; a call updates the integral in place.
    effort
        Efforts of the last call (envs, dof).
    limited
        1 for joints whose effort the limits have changed in the last call, else 0 (envs, dof).
    address
        Address of the call: ``control`` of :class:`batchpid.sim.engine.native.interface.Tick`.
    """

    def __init__(
        self,
        k: OSCCoefficients,
        tool: tuple[Array, ...],
        parts: Mapping[str, slice],
        columns: NDArray[np.intp],
        damping: Float64 | None,
        friction: tuple[Float64, Float64] | None,
        timestep: float,
        reading: tuple[Float64, Float64, Float64],
    ) -> None:
        qpos = reading[0]
        rows = len(qpos)
        self._parts, self._columns = {"setpoint": slice(0, 7), **parts}, columns
        self._given = {name: np.zeros((rows, part.stop - part.start)) for name, part in self._parts.items()}
        self._posture = np.zeros_like(qpos)
        self.state = {"posture": np.zeros_like(qpos)}
        if k.ki_dt is not None:
            self.state["integral"] = np.zeros((rows, 6))
        self.effort, self.limited = np.zeros((2, *qpos.shape))
        integral, known = (
            self.state.get("integral"),
            dict[str, Any](zip(("qpos", "qvel", "bias"), reading, strict=True)),
        )
        known |= {"posture": self._posture, "integral": integral, "next_integral": integral, "effort": self.effort}
        known["limited"] = self.limited
        if damping is not None:
            known |= {"damping": damping, "added_inertia": timestep * damping}
        if friction is not None:
            known |= dict(zip(("coulomb", "band"), friction, strict=True))
        tree, link, point = tool
        bound = native_law.bind(tree, link, point, k, {**self._given, **known})
        assert bound is not None
        self._kept, self.address = bound

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Copy a state."""
        for name, array in self.state.items():
            array[...] = state[name]

    def load(self, setpoint: Float64) -> None:
        """Copy the setpoints of a tick (envs, size); joints without a column in them keep the state's posture."""
        for name, part in self._parts.items():
            self._given[name][...] = setpoint[:, part]
        self._posture[...] = np.where(self._columns > 0, setpoint[:, self._columns], self.state["posture"])
