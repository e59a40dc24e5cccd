"""Operational-space control in native code, for any number of rows: task_space.cpp."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.native.task_space_extension import DECOUPLING, FRICTION, KINEMATICS, LAW
from batchpid.task_space import native_rows
from batchpid.task_space.kinematic_tree import KinematicTree
from batchpid.task_space.osc_coefficients import OSCCoefficients
from batchpid.task_space.osc_params import NoDecoupling, PartialDecoupling

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
    (rows, dof), sizes = qpos.shape, _SIZES
    found = {name: np.empty((rows, sizes.get(name, dof))) for name in wanted}
    native_rows.call(native.law, rows, dof, *_kind(k), *arrays, *map(found.get, _RESULTS))
    return list(found.values())


def friction(arrays: Mapping[str, Any]) -> Float64 | None:
    """Return the friction (envs, dof) on the way to a setpoint, from arrays by their names in FRICTION.

    The result is None where native code is not used. With ``damping`` the efforts of damping are included.
    """
    qpos = arrays["qpos"]
    native = native_rows.for_rows(qpos, *arrays.values())
    if native is None:
        return None
    found = np.empty(qpos.shape)
    native_rows.call(native.friction, *qpos.shape, *({**arrays, "feedforward": found}.get(name) for name in FRICTION))
    return found


def bind(
    tree: KinematicTree, link: str, point: Any, k: OSCCoefficients, arrays: Mapping[str, Any]
) -> tuple[Any, int] | None:
    """Return an object that keeps ``arrays``, and the address of a Call (call.h) that runs a step of the law on them.

    ``arrays`` are contiguous float64 arrays by their names in LAW, with ``bias`` among them. The tool is at a ``point``
    (3,) of ``link``, by default at its origin. With ``coulomb`` and ``band`` the feedforward is friction. The result is
    None where native code is not used.
    """
    if (native := native_rows.in_use()) is None:
        return None
    own, index, (rows, dof) = native_rows.native_tree(native, tree), tree.index(link), arrays["qpos"].shape
    body = tree.link_bodies[index]
    dynamics = native_rows.empty(("pose", "jacobian", "jacobian_rate", "mass_matrix"), (rows,), dof)
    fixed = {"tool": native_rows.tool(own, index, point), "chain": np.array(tree.chains[body], np.float64)}
    known = {**dict(zip(k._fields[:-2], k[:-2], strict=True)), **arrays, **dynamics, **fixed}
    motion = [None if name == "bias" else known[name] for name in KINEMATICS]
    rubbing = [None] * len(FRICTION)
    if "coulomb" in arrays:
        known["feedforward"] = np.zeros((rows, dof))
        rubbing = [known.get(name) for name in FRICTION]
        known["damping"] = None  # part of the feedforward
    return native.bind(own.tree, body, rows, *_kind(k), *motion, *map(known.get, LAW), *rubbing)


def _kind(k: OSCCoefficients) -> tuple[int, bool]:
    """Return the index in DECOUPLING, and whether the coefficients are in the axes of the tool."""
    kind = {NoDecoupling: "none", PartialDecoupling: "partial"}.get(type(k.decoupling), "full")
    return DECOUPLING.index(kind), k.frame is not None
