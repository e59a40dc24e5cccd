"""Laws compiled by JAX and called once per sim step, for ticks that cannot be one program."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Pytree, Rows
from batchpid.arrays.jax_settings import own_settings
from batchpid.sim.loop.custom import OwnController
from batchpid.sim.loop.pid_law import PIDLaw
from batchpid.sim.runner_keywords import Precision

ROWS = 16
"""Number of which the rows in a JAX program are a multiple, for any number of envs in a group.

Thus one program serves all groups, and an env's results do not depend on its group.
"""


def program_rows(envs: int) -> int:
    """Return the number of rows in a program for ``envs`` envs."""
    return -(-envs // ROWS) * ROWS


def padded(rows: Any) -> Rows:
    """Return ``rows`` (envs, ...) followed by copies of the first row, up to the number of rows in a program."""
    rows = np.asarray(rows)
    missing = program_rows(len(rows)) - len(rows)
    return np.concatenate([rows, np.repeat(rows[:1], missing, 0)]) if missing else rows


def put(tree: Pytree) -> Any:
    """Return a structure of arrays as JAX arrays on the CPU."""
    import jax

    return jax.device_put(tree, jax.local_devices(backend="cpu")[0])


def jitted_law(dtype: Precision, envs: int, law: PIDLaw, *inputs: Any) -> Any:
    """Return the result of :meth:`PIDLaw.advance`, compiled by JAX, for ``envs`` envs."""
    return _call(_jitted(law.advance), dtype, envs, *inputs)


def jitted_controller(dtype: Precision, envs: int, controller: OwnController, *inputs: Any) -> Any:
    """Return the result of :meth:`OwnController.traced`, compiled by JAX, for ``envs`` envs."""
    return _call(_jitted(controller.traced), dtype, envs, *inputs)


@lru_cache(maxsize=8)
def _jitted(call: Callable[..., Any]) -> Any:
    import jax

    return jax.jit(call)


def _call(function: Any, dtype: Precision, envs: int, *inputs: Any) -> Any:
    """Call a jitted function with padded inputs (envs, ...); return its results as NumPy arrays (envs, ...)."""
    import jax

    with own_settings(dtype):
        results = function(*put(jax.tree.map(padded, inputs)))
        return jax.tree.map(lambda rows: np.array(rows)[:envs], results)
