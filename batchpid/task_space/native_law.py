"""Operational-space control in native code, for any number of rows, or within the sim steps of a
tick.

The code is in task_space.cpp.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Array, Document, Float64
from batchpid.native.extensions import LAW
from batchpid.task_space import native_rows
from batchpid.task_space.osc_state import (
    OSCCoefficients,
    OSCInputs,
    OSCState,
    OSCTerms,
    TaskDynamics,
    Tool,
)
from batchpid.task_space.rigid_tree import RigidTree
from batchpid.task_space.tree_kinematics import prepared, read_point

_LAW_RESULTS = {
    "effort": 0,
    "integral": 6,
    "limited": 0,
    "error": 6,
    "wrench": 6,
    "task": 0,
    "posture": 0,
    "unsaturated": 0,
    "task_share": 1,
    "posture_share": 1,
    "near_singular": 1,
}
"""Terms and state in the order of the results in LAW, and their columns; 0 for one per joint."""
_WITHOUT_TREE = None, -1, None
"""Tree, body and tool of a law whose dynamics are among its arrays."""


def law(
    k: OSCCoefficients,
    state: OSCState,
    dynamics: TaskDynamics | Tool,
    inputs: OSCInputs,
    wanted: tuple[str, ...],
) -> tuple[OSCState, OSCTerms] | None:
    """Return the results of :func:`batchpid.task_space.osc`; None where native code is not used.

    Raises ValueError if an array has a wrong shape.
    """
    # With a tool the extension computes the dynamics itself, from the tree's tables.
    tool: Tool | None = None
    dynamics_arrays: tuple[Any, ...] = dynamics
    if isinstance(dynamics, Tool):
        tool = dynamics
        (qpos, qvel), *_ = prepared(tool.tree, qpos=inputs.qpos, qvel=inputs.qvel)
        inputs = inputs._replace(qpos=qpos, qvel=qvel)
        dynamics_arrays = (read_point(qpos, tool.point),)
    arrays = (*inputs, None, None, None, *state, *k[:-1], None, None)
    if (native := native_rows.for_rows(inputs.qpos, *dynamics_arrays, *arrays)) is None:
        return None
    rows, dof = inputs.qpos.shape
    # The new integral is a result like the terms, though no caller names it.
    needed = wanted
    if state.integral is not None:
        needed = (*wanted, "integral")
    results = [
        np.empty((rows, size or dof)) if name in needed else None
        for name, size in _LAW_RESULTS.items()
    ]
    fixed: tuple[Any, ...] = (k.frame is not None, *_WITHOUT_TREE)
    if tool is not None:
        fixed, chain = _of_tree(native, tool.tree, tool.link, dynamics_arrays[0], k)
        dynamics_arrays = (*[None] * 5, chain)
    native_rows.call(
        native.law,
        rows,
        dof,
        *fixed,
        *dynamics_arrays,
        *arrays,
        *results,
    )
    effort, integral, _, *parts, s1, s2, near = results
    # The extension writes columns; the terms are one number for each env.
    shares = [None if entry is None else entry[:, 0] for entry in (s1, s2)]
    terms = OSCTerms._make((*parts, effort, *shares, None if near is None else near[:, 0] > 0))
    return (state if integral is None else state._replace(integral=integral)), terms


def _of_tree(
    native: Any,
    tree: RigidTree,
    link: str,
    point: Array,
    k: OSCCoefficients,
) -> tuple[tuple[Any, ...], Float64]:
    """Return the arguments of ``law`` and ``bind`` between sizes and arrays, and the chain to the
    tool (dof,).
    """
    index = tree.index(link)
    body = tree.link_bodies[index]
    capsule = native_rows.native_tree(native, tree)
    fixed = k.frame is not None, capsule, body, native_rows.tool(tree, index, point)
    return fixed, np.array(tree.chains[body], np.float64)


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
        Address of the call: ``control`` of Tick in tick.h.
    """

    def __init__(
        self,
        k: OSCCoefficients,
        tool: Tool,
        parts: Mapping[str, slice],
        columns: NDArray[np.intp],
        damping: Float64 | None,
        friction: tuple[Float64, Float64] | None,
        timestep: float,
        reading: tuple[Float64, Float64, Float64],
        left: Float64,
    ) -> None:
        qpos, qvel, bias = reading
        (rows, dof), native = qpos.shape, native_rows.in_use()
        assert native is not None
        self._parts = {"setpoint": slice(0, 7), **parts}
        self._columns = columns
        self._given = {
            name: np.zeros((rows, part.stop - part.start)) for name, part in self._parts.items()
        }
        if "twist" in parts:  # the pose moves within the tick
            self._given["left"] = left.reshape(1, 1)
        self._posture = np.zeros_like(qpos)
        # The call keeps the addresses of these arrays: they are written in place from now on.
        self.state = {"posture": np.zeros_like(qpos)}
        if k.ki_dt is not None:
            self.state["integral"] = np.zeros((rows, 6))
        self.effort, self.limited = np.zeros((2, *qpos.shape))
        fixed, chain = _of_tree(native, tool.tree, tool.link, tool.point, k)
        integral = self.state.get("integral")
        arrays: Document = dict(zip(k._fields[:-1], k[:-1], strict=True)) | self._given
        arrays |= {
            "qpos": qpos,
            "qvel": qvel,
            "bias": bias,
            "chain": chain,
            "posture": self._posture,
        }
        arrays |= {
            "integral": integral,
            "next_integral": integral,
            "effort": self.effort,
            "limited": self.limited,
        }
        # Implicit damping appears to the law as an inertia of dt times it.
        if damping is not None:
            arrays |= {"damping": damping, "added_inertia": timestep * damping}
        if friction is not None:
            arrays["coulomb"], arrays["band"] = friction
        self._kept, self.address = native.bind(rows, dof, *fixed, *map(arrays.get, LAW))

    def set_state(self, state: Document) -> None:
        """Copy a state."""
        for name, array in self.state.items():
            array[...] = state[name]

    def load(self, setpoint: Float64) -> None:
        """Copy the setpoints of a tick (envs, size); joints without a column in them keep the
        state's posture.
        """
        for name, part in self._parts.items():
            self._given[name][...] = setpoint[:, part]
        self._posture[...] = np.where(
            self._columns > 0, setpoint[:, self._columns], self.state["posture"]
        )
