"""The law over a large batch on JAX's CPU backend, block by block.

XLA compiles one kernel per output there, and each reads the inputs again: in a large batch from
memory, into buffers that the system maps page by page. A block of a thousand rows stays in the
cache between its kernels, and its results overwrite arrays that are no longer needed. Blocks are
flat, so that rows of 9 joints fill the processor's vectors of 8 or 16.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from batchpid.arrays.array_types import Array
from batchpid.law.coefficients import Coefficients
from batchpid.law.pid import advance
from batchpid.law.state import PIDState

ROWS = 1024
"""Envs per block."""


def advance_in_blocks(
    k: Coefficients,
    state: PIDState,
    *inputs: Array,
    out: tuple[PIDState, Array] | None = None,
    rows: int = ROWS,
) -> tuple[PIDState, Array]:
    """Advance the law ``rows`` envs at a time, for jax.jit with ``out`` donated.

    ``inputs`` are the inputs of :func:`batchpid.advance`, in order: setpoint, measurement and,
    optionally, measurement_rate, setpoint_rate, feedforward. ``out`` is a state and an effort,
    (envs, joints) each, to overwrite, such as the results of the step before last, but not
    ``state`` itself; None takes new ones. On several devices use it under ``jax.shard_map``, each
    device with a part of the envs.
    """
    measurement = inputs[1]
    envs, joints = measurement.shape
    if envs <= rows:
        state, terms = advance(k, state, *inputs)
        return state, terms.effort
    if out is None:
        out = (jax.tree.map(jnp.zeros_like, state), jnp.zeros_like(measurement))
    # All arrays are flat from here on; shared rows fill a block.
    block = rows * joints
    total = envs * joints

    def flat(x: Array) -> Array:  # a row that all envs share is repeated over a block
        if jnp.ndim(x) < 2:
            return x
        return (jnp.tile(x, (rows, 1)) if x.shape[0] == 1 else x).reshape(-1)

    def step(n: Array, out: Array) -> Any:
        # The last block may repeat some rows of the one before.
        start = jnp.minimum(n * block, total - block)

        def cut(x: Array) -> Array:
            if jnp.shape(x) == (total,):
                return jax.lax.dynamic_slice_in_dim(x, start, block)
            return x

        new, terms = advance(*jax.tree.map(cut, arguments))
        done = new, terms.effort
        return jax.tree.map(
            lambda x, part: jax.lax.dynamic_update_slice_in_dim(x, part, start, 0), out, done
        )

    arguments = jax.tree.map(flat, (k, state, *inputs))
    out = jax.lax.fori_loop(0, -(-envs // rows), step, jax.tree.map(flat, out))
    results: tuple[PIDState, Array] = jax.tree.map(lambda x: x.reshape(envs, joints), out)
    return results
