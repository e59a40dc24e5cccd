"""Kinematics, dynamics, inverse kinematics and operational-space control of NumPy arrays in native
code, for any number of rows: task_space.cpp.

Functions return None where native code is not used: switched off (``BATCHPID_NATIVE=0``), not
built, or for arrays of another library. The caller then computes the same in NumPy, the definition;
results differ in their last bits, since sums have another order.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from functools import cache
from types import ModuleType
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Array, Document, Float64
from batchpid.arrays.elementwise import namespace
from batchpid.native.array_program import SWITCH, obstacle
from batchpid.native.extensions import KINEMATICS, LAW, TASK_SPACE, load
from batchpid.task_space.frames import rotate
from batchpid.task_space.osc_params import OSCParams
from batchpid.task_space.osc_state import (
    OSCInputs,
    OSCState,
    OSCTerms,
    TaskDynamics,
    Tool,
)
from batchpid.task_space.rigid_tree import RigidTree
from batchpid.task_space.tree_kinematics import prepared, read_point

_SHAPES: dict[str, tuple[int, ...]] = {
    "pose": (7,),
    "jacobian": (6, -1),
    "jacobian_rate": (6,),
    "mass_matrix": (-1, -1),
    "bias": (-1,),
}
"""Shapes of the results of :func:`kinematics`; -1 stands for the degrees of freedom."""
_TERMS = {
    "error": 6,
    "force": 6,
    "task": 0,
    "posture_effort": 0,
    "unsaturated": 0,
    "effort": 0,
    "task_share": 1,
    "posture_share": 1,
    "near_singular": 1,
}
"""Results in LAW for the fields of OSCTerms, and their columns; 0 for one per joint."""
_trees: WeakKeyDictionary[RigidTree, Any] = WeakKeyDictionary()


def in_use(*arrays: Array) -> ModuleType | None:
    """Return the extension, or None where native code is not used, as for arrays of other
    libraries.
    """
    if os.environ.get(SWITCH) == "0" or namespace(*arrays) is not np:
        return None
    return _extension()


@cache
def _extension() -> ModuleType | None:
    if obstacle():
        return None
    return load(TASK_SPACE)


def kinematics(
    tree: RigidTree,
    wanted: tuple[str, ...],
    qpos: Array,
    qvel: Array,
    index: int,
    point: Array,
) -> dict[str, Float64] | None:
    """Return the ``wanted`` arrays (..., ...), of "pose", "jacobian", "jacobian_rate",
    "mass_matrix" and "bias".

    The first three belong to a ``point`` (3,) or (..., 3) of the link ``index``. "jacobian_rate"
    and "bias" need ``qvel``. ``qpos`` and ``qvel`` are checked arrays (..., dof).
    """
    native = in_use(qpos, point)
    # The mass matrix of a floating base is a Schur complement, which NumPy computes.
    if native is None or not (tree.fixed_base or {"mass_matrix", "bias"}.isdisjoint(wanted)):
        return None
    *leading, dof = qpos.shape
    rows = math.prod(leading)
    results = {}
    for name in wanted:
        shape = [dof if size < 0 else size for size in _SHAPES[name]]
        results[name] = np.empty((*leading, *shape))
    call(
        native.kinematics,
        native_tree(native, tree),
        tree.link_bodies[index],
        rows,
        *[None if x is None else x.reshape(rows, dof) for x in (qpos, qvel)],
        tool_frames(tree, index, point),
        *[results.get(name) for name in KINEMATICS[3:]],
    )
    return results


def search(
    tree: RigidTree,
    index: int,
    point: Array,
    goal: Array,
    start: Array,
    tolerance: Array,
    iterations: int,
) -> list[Float64] | None:
    """Search, from ``start`` (n, dof), for joint positions within the limits of the tree that bring
    a tool to the poses ``goal`` (n, 7).

    Return the nearest positions (n, dof), their errors (n, 2) and their numbers of steps (n, 1).
    The tool is at a ``point`` (3,) of the link ``index``; ``tolerance`` is (2,).
    """
    if (native := in_use()) is None:
        return None
    rows = len(start)
    results = [start.copy(), np.empty((rows, 2)), np.empty((rows, 1))]
    call(
        native.search,
        native_tree(native, tree),
        tree.link_bodies[index],
        rows,
        iterations,
        goal,
        tool_frames(tree, index, point),
        np.asarray(tree.lower)[None],
        np.asarray(tree.upper)[None],
        tolerance[None],
        *results,
    )
    return results


def law(
    k: OSCParams,
    state: OSCState,
    dynamics: TaskDynamics | Tool,
    inputs: OSCInputs,
) -> tuple[OSCState, OSCTerms] | None:
    """Return the results of :func:`batchpid.task_space.osc`.

    Raises ValueError if an array has a wrong shape.
    """
    arrays: Document = inputs._asdict() | state._asdict() | k._asdict()
    point = None
    # With a tool the extension computes the dynamics itself, from the tree's tables.
    if isinstance(dynamics, Tool):
        (qpos, qvel), *_ = prepared(dynamics.tree, qpos=inputs.qpos, qvel=inputs.qvel)
        arrays |= {"qpos": qpos, "qvel": qvel}
        point = read_point(qpos, dynamics.point)
    else:
        arrays |= dynamics._asdict()
    native = in_use(*arrays.values(), point)
    if native is None or inputs.qpos.ndim != 2:
        return None
    rows, dof = inputs.qpos.shape
    results = {name: np.empty((rows, size or dof)) for name, size in _TERMS.items()}
    arrays |= results
    tree_arguments: tuple[Any, ...] = None, -1, None
    if isinstance(dynamics, Tool):
        tree_arguments, arrays["chain"] = _of_tree(native, dynamics.tree, dynamics.link, point)
    if state.integral is not None:
        arrays["next_integral"] = np.empty((rows, 6))
        state = state._replace(integral=arrays["next_integral"])
    call(
        native.law,
        rows,
        dof,
        *tree_arguments,
        *map(arrays.get, LAW),
    )
    # The extension writes columns; the last terms are one number for each env.
    *parts, s1, s2, near_singular = results.values()
    terms = OSCTerms._make((*parts, s1[:, 0], s2[:, 0], near_singular[:, 0] > 0))
    return state, terms


def _of_tree(
    native: ModuleType,
    tree: RigidTree,
    link: str,
    point: Array,
) -> tuple[tuple[object, int, Float64], Float64]:
    """Return the tree, the body and the frames of a tool for ``law`` and ``bind``, and the chain to
    the tool (dof,).
    """
    index = tree.index(link)
    body = tree.link_bodies[index]
    return (native_tree(native, tree), body, tool_frames(tree, index, point)), tree.chains[body]


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
        k: OSCParams,
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
        (rows, dof), native = qpos.shape, in_use()
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
        tree_arguments, chain = _of_tree(native, tool.tree, tool.link, tool.point)
        integral = self.state.get("integral")
        arrays: Document = k._asdict() | self._given
        arrays |= {
            "qpos": qpos,
            "qvel": qvel,
            "bias": bias,
            "chain": chain,
            "posture": self._posture,
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
        self._kept, self.address = native.bind(
            rows,
            dof,
            *tree_arguments,
            *map(arrays.get, LAW),
        )

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


def tool_frames(tree: RigidTree, index: int, point: Array) -> Float64:
    """Return the frames (1 | rows, 12) of a link in its body, with the origin at a ``point`` (3,)
    or (..., 3).
    """
    frames = tree.bodies.link_frames[index]
    if point is not None:
        frames = np.broadcast_to(frames, (*point.shape[:-1], 3, 4)).copy()
        frames[..., 3] += rotate(frames[..., :3], point)
    rows: Float64 = frames.reshape(-1, 12)
    return rows


def native_tree(native: ModuleType, tree: RigidTree) -> object:
    """Return the capsule of the extension with the constants of a tree."""
    if tree not in _trees:
        bodies, (kinds, rows), coupling = tree.bodies, tree.tables, tree.coupling
        _trees[tree] = native.tree(
            tree.dof,
            kinds,
            rows,
            bodies.armature,
            tuple(bodies.gravity.tolist()),
            coupling.leader.astype(np.int32),
            coupling.multiplier,
            coupling.offset,
        )
    return _trees[tree]


def call(function: Callable[..., None], *arguments: object) -> None:
    """Call a function of the extension, which takes contiguous arrays of float64 only; others are
    converted.
    """
    try:
        # Nearly all arrays fit as they are: the refusal is cheaper than a look at each.
        function(*arguments)
    except (ValueError, BufferError):
        function(
            *[
                np.ascontiguousarray(x, np.float64) if isinstance(x, np.ndarray) else x
                for x in arguments
            ]
        )
