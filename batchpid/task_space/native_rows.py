"""Kinematics and inverse kinematics of NumPy arrays in native code, for any number of rows:
task_space.cpp.

Each function takes float64 arrays and returns None where native code is not used: switched off
(``BATCHPID_NATIVE=0``), not built, or for arrays of another library. The caller then computes the
same in NumPy, the definition; results differ in their last bits, since sums have another order.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from functools import cache
from types import ModuleType
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from batchpid.arrays.array_types import Array, Float64
from batchpid.native.array_program import SWITCH, obstacle
from batchpid.native.extensions import KINEMATICS, TASK_SPACE, load
from batchpid.task_space.rigid_tree import RigidTree

_SIZES = {
    "pose": (7,),
    "jacobian": (6, -1),
    "jacobian_rate": (6,),
    "mass_matrix": (-1, -1),
    "bias": (-1,),
}
"""Shapes of the results of :func:`kinematics`; -1 stands for the degrees of freedom."""
_PLAIN_ARRAYS = frozenset({np.ndarray, type(None)})
_DYNAMICS = {"mass_matrix", "bias"}
"""Results that the extension computes on a fixed base alone."""


_trees: WeakKeyDictionary[RigidTree, Any] = WeakKeyDictionary()


def in_use() -> ModuleType | None:
    """Return the extension, or None where native code is not used."""
    if os.environ.get(SWITCH) == "0":
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
    qvel: Array = None,
    index: int = 0,
    point: Array = None,
) -> dict[str, Float64] | None:
    """Return the ``wanted`` arrays (..., ...), of "pose", "jacobian", "jacobian_rate",
    "mass_matrix" and "bias".

    The first three belong to a ``point`` (3,) or (..., 3) of the link ``index``. "jacobian_rate"
    and "bias" need ``qvel``. ``qpos`` and ``qvel`` are checked arrays (..., dof).
    """
    if type(qpos) is np.ndarray and (point is None or isinstance(point, np.ndarray)):
        native = in_use()
    else:
        native = None
    # The mass matrix of a floating base is a Schur complement, which NumPy computes.
    if native is None or not (tree.fixed_base or _DYNAMICS.isdisjoint(wanted)):
        return None
    dof = tree.dof
    leading = qpos.shape[:-1]
    rows = math.prod(qpos.shape[:-1])
    # The extension writes into arrays that it is given, by rows.
    outputs = empty(wanted, leading, dof)
    inputs = [None if x is None else x.reshape(rows, dof) for x in (qpos, qvel)]
    call(
        native.kinematics,
        *_arguments(
            native,
            tree,
            outputs,
            inputs,
            index,
            point,
        ),
    )
    return outputs


def _arguments(
    native: Any,
    tree: RigidTree,
    outputs: dict[str, Float64],
    inputs: Any,
    index: int,
    point: Array,
) -> list[Any]:
    """Return the arguments of ``kinematics`` in task_space.cpp."""
    rows = len(inputs[0])
    results = [outputs.get(name) for name in KINEMATICS[3:]]
    return [
        native_tree(native, tree),
        tree.link_bodies[index],
        rows,
        *inputs,
        tool(tree, index, point),
        *results,
    ]


def empty(wanted: tuple[str, ...], leading: tuple[int, ...], dof: int) -> dict[str, Float64]:
    """Return arrays for the results ``wanted`` of :func:`kinematics`."""
    shapes = {name: tuple([dof if size < 0 else size for size in _SIZES[name]]) for name in wanted}
    return {name: np.empty((*leading, *shape)) for name, shape in shapes.items()}


def search(
    tree: RigidTree,
    index: int,
    point: Array,
    limits: tuple[Float64, Float64],
    goal: Array,
    start: Array,
    tolerance: Array,
    iterations: int,
) -> list[Float64] | None:
    """Search, from ``start`` (n, dof), for joint positions within ``limits`` (dof,) that bring a
    tool to the poses ``goal`` (n, 7).

    Return the nearest positions (n, dof), their errors (n, 2) and their numbers of steps (n, 1).
    The tool is at a ``point`` (3,) of the link ``index``; ``tolerance`` is (2,).
    """
    if (native := in_use()) is None:
        return None
    rows = len(start)
    outputs = [start.copy(), np.full((rows, 2), np.inf), np.zeros((rows, 1))]
    arrays = (
        goal,
        tool(tree, index, point),
        *(limit[None] for limit in limits),
        tolerance[None],
    )
    call(
        native.search,
        native_tree(native, tree),
        tree.link_bodies[index],
        rows,
        iterations,
        *arrays,
        *outputs,
    )
    # A search moves leaders alone; their followers are set at the end.
    outputs[0] = tree.positions(outputs[0])
    return outputs


def tool(tree: RigidTree, index: int, point: Array) -> Float64:
    """Return the frames (1 | rows, 12) of a link in its body, with the origin at a ``point`` (3,)
    or (..., 3).
    """
    tool = tree.bodies.link_frames[index]
    if point is not None:
        tool = np.broadcast_to(tool, (*point.shape[:-1], 3, 4)).copy()
        tool[..., 3] += (tool[..., :3] * point[..., None, :]).sum(-1)
    frames: Float64 = tool.reshape(-1, 12)
    return frames


def native_tree(native: ModuleType, tree: RigidTree) -> object:
    """Return the capsule of the extension with the constants of a tree."""
    if tree not in _trees:
        bodies, (kinds, rows) = tree.bodies, tree.tables
        arguments = kinds, rows, np.array(bodies.armature), tuple(bodies.gravity.tolist())
        coupling = tree.coupling
        laws = coupling.leader.astype(np.int32), coupling.multiplier, coupling.offset
        _trees[tree] = native.tree(tree.dof, *arguments, *laws)
    return _trees[tree]


def for_rows(like: Array, *arrays: Array) -> ModuleType | None:
    """Return the extension if all arrays are NumPy's and ``like`` is (envs, columns), else None."""
    plain = _PLAIN_ARRAYS.issuperset(map(type, arrays)) or all(
        x is None or isinstance(x, np.ndarray) for x in arrays
    )
    if plain and like.ndim == 2:
        return in_use()
    return None


def call(function: Callable[..., None], *arguments: object) -> None:
    """Call a function of the extension, which takes contiguous arrays of float64 only; others are
    converted.
    """
    try:
        # Nearly all arrays fit as they are: the refusal is cheaper than a look at each.
        function(*arguments)
    except (ValueError, BufferError):
        function(*[_contiguous(one) if isinstance(one, np.ndarray) else one for one in arguments])


def _contiguous(array: Array) -> Array:
    if array is None:
        return None
    return np.ascontiguousarray(array, np.float64)
