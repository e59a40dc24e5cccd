"""Operational-space control in native code, for any number of rows: task_space.cpp."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.native.task_space_extension import DECOUPLING, FRICTION, LAW
from batchpid.task_space import native_rows
from batchpid.task_space.osc_coefficients import OSCCoefficients
from batchpid.task_space.osc_params import NoDecoupling, PartialDecoupling
from batchpid.task_space.rigid_tree import RigidTree

Float64 = NDArray[np.float64]

_RESULTS = LAW[LAW.index("effort") :]
_SIZES = {"next_integral": 6, "error": 6, "force": 6, "task_share": 1, "posture_share": 1, "near_singular": 1}


def law(k: OSCCoefficients, dynamics: Any, inputs: tuple[Any, ...], wanted: tuple[str, ...]) -> list[Float64] | None:
    """Return the results ``wanted``, by their names in LAW, of a step of the law of operational_space.py.

    ``dynamics`` and ``inputs`` are the arrays that precede the coefficients in LAW, in that order. The result is None
    where native code is not used.
    """
    arrays, qpos = (*dynamics, *inputs, *k[:-2]), inputs[1]
    native = native_rows.for_rows(qpos, *arrays)
    if native is None:
        return None
    found = _empty(qpos.shape, wanted)
    native_rows.call(native.law, *qpos.shape, *_kind(k), *arrays, *map(found.get, _RESULTS))
    return list(found.values())


def step(
    tree: RigidTree, link: str, point: Any, k: OSCCoefficients, inputs: tuple[Any, ...], wanted: tuple[str, ...]
) -> list[Float64] | None:
    """Return the results of :func:`law` with the dynamics of ``tree``: a ``point`` (3,) of ``link`` is the tool."""
    qpos = inputs[1]
    if (native := native_rows.for_rows(qpos, *inputs, *k[:-2], point)) is None:
        return None
    found = _empty(qpos.shape, wanted)
    fixed, chain = _of_tree(native, tree, link, point, len(qpos), k)
    native_rows.call(native.step, *fixed, *[None] * 5, chain, *inputs, *k[:-2], *map(found.get, _RESULTS))
    return list(found.values())


def friction(arrays: Mapping[str, Any]) -> Float64 | None:
    """Return the friction (envs, dof) on the way to a setpoint, from arrays by their names in FRICTION.

    The result is None where native code is not used. With ``damping`` the efforts of damping are included.
    """
    qpos = arrays["qpos"]
    if (native := native_rows.for_rows(qpos, *arrays.values())) is None:
        return None
    found = np.empty(qpos.shape)
    native_rows.call(native.friction, *qpos.shape, *({**arrays, "feedforward": found}.get(name) for name in FRICTION))
    return found


def bind(
    tree: RigidTree, link: str, point: Any, k: OSCCoefficients, arrays: Mapping[str, Any]
) -> tuple[Any, int] | None:
    """Return an object that keeps ``arrays``, and the address of a Call (call.h) that runs :func:`step` on them.

    ``arrays`` are contiguous float64 arrays by their names in LAW; without ``bias`` it is the tree's. The tool is at a
    ``point`` (3,) of ``link``, by default at its origin. With ``coulomb`` and ``band`` (dof,) the feedforward is
    friction. The result is None where native code is not used.
    """
    if (native := native_rows.in_use()) is None:
        return None
    fixed, chain = _of_tree(native, tree, link, point, len(arrays["qpos"]), k)
    known = {**dict(zip(k._fields[:-2], k[:-2], strict=True)), **arrays, "chain": chain}
    rubbing = [None, None, None]
    if "coulomb" in arrays:  # damping is part of this friction, and not an input of the law
        rubbing = [known.pop(name, None) for name in ("damping", "coulomb", "band")]
    return native.bind(*fixed, *map(known.get, LAW), *rubbing)


def _of_tree(
    native: Any, tree: RigidTree, link: str, point: Any, rows: int, k: OSCCoefficients
) -> tuple[tuple[Any, ...], Float64]:
    """Return the arguments of ``step`` and ``bind`` before the arrays of the law, and the chain to the tool (dof,)."""
    own, index = native_rows.native_tree(native, tree), tree.index(link)
    body = tree.link_bodies[index]
    fixed = own.tree, body, rows, native_rows.tool(own, index, point), *_kind(k)
    return fixed, np.array(tree.chains[body], np.float64)


def _empty(shape: tuple[int, int], wanted: tuple[str, ...]) -> dict[str, Float64]:
    """Return arrays for the results ``wanted``."""
    return {name: np.empty((shape[0], _SIZES.get(name, shape[1]))) for name in wanted}


def _kind(k: OSCCoefficients) -> tuple[int, bool]:
    """Return the index in DECOUPLING, and whether the coefficients are in the axes of the tool."""
    kind = {NoDecoupling: "none", PartialDecoupling: "partial"}.get(type(k.decoupling), "full")
    return DECOUPLING.index(kind), k.frame is not None
