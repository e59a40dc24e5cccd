"""Functions of the extension in programs of JAX, on the CPU."""

from __future__ import annotations

import ctypes
import os
import threading
from functools import cache

import numpy as np

from batchpid.arrays.array_types import Array
from batchpid.sim.engine import native

_lock = threading.Lock()


def obstacle() -> str:
    """Return why programs of JAX cannot call the extension; "" if they can. Imports JAX."""
    if reason := native.obstacle():
        return reason
    platforms = os.environ.get("JAX_PLATFORMS") or "cpu"
    if "cpu" not in platforms.split(","):
        return f"JAX has no CPU, since JAX_PLATFORMS is {platforms!r}: add cpu to it"
    with _lock:  # JAX takes a name once
        return _registered()


@cache
def _registered() -> str:
    """Register the functions with JAX; return the problem, or ""."""
    import jax

    for name, address in native.extension("_gateway").xla_functions().items():
        try:
            jax.ffi.register_ffi_target(
                name, jax.ffi.pycapsule(ctypes.c_void_p(address)), platform="cpu"
            )
        except Exception as error:  # JAX promises no type
            return f"JAX {jax.__version__} does not take the extension's functions: {error}"
    return ""


def sim_step(address: Array, step: Array, effort: Array) -> tuple[Array, ...]:
    """Do a sim step of a :class:`batchpid.sim.engine.native_model.NativeStep` in a program of JAX.

    Order is kept by the data and by the number of the step, which is another in each call.

    Parameters
    ----------
    address
        Of the group, as uint32 (2,).
    step
        int32 number.
    effort
        (rows, dof) [N m or N], of as many rows as robots, or more.

    Returns
    -------
    qpos, qvel, passive force (rows, dof), and status
        Further rows repeat the first.
    """
    import jax

    obstacle()  # registers the function in this process
    like = jax.ShapeDtypeStruct(effort.shape, effort.dtype)
    results = (like, like, like, jax.ShapeDtypeStruct((), np.int32))
    qpos, qvel, passive, status = jax.ffi.ffi_call("batchpid_sim_step", results)(
        address, step, effort
    )
    return qpos, qvel, passive, status


def mass_matrix(tree: Array, bodies: Array, qpos: Array) -> Array:
    """Return the mass matrices (rows, dof, dof) [kg m^2 or kg] at ``qpos`` (rows, dof) in a program
    of JAX, of float64.

    ``tree`` (dof, 2) and ``bodies`` (dof, 25) are arrays of
    :attr:`batchpid.task_space.RigidTree.tables`.
    """
    import jax

    result = jax.ShapeDtypeStruct((*qpos.shape, qpos.shape[-1]), qpos.dtype)
    return jax.ffi.ffi_call("batchpid_mass_matrix", result)(tree, bodies, qpos)
