"""Debugging settings of JAX, under which batchpid gives the results of the default settings."""

from __future__ import annotations

import contextlib
from concurrent.futures import ThreadPoolExecutor

import jax

SETTINGS = {
    "jax_debug_nans": True,
    "jax_debug_infs": True,
    "jax_numpy_rank_promotion": "raise",
    "jax_numpy_dtype_promotion": "strict",
    "jax_transfer_guard": "disallow",
    "jax_transfer_guard_host_to_device": "disallow_explicit",
    "jax_transfer_guard_device_to_device": "disallow_explicit",
    "jax_disable_jit": True,
    "jax_enable_x64": True,
    "jax_check_tracer_leaks": True,
    "jax_log_compiles": True,
    "jax_explain_cache_misses": True,
    "jax_enable_checks": True,
}


@contextlib.contextmanager
def changed(**values):
    """Change settings of the process, as jax.config.update does, within a block."""
    # In another thread, where the contexts of this one do not hide the settings of the process.
    with ThreadPoolExecutor(1) as thread:
        before = thread.submit(
            lambda: {name: getattr(jax.config, name) for name in values}
        ).result()
    try:
        for name, value in values.items():
            jax.config.update(name, value)
        yield
    finally:
        for name, value in before.items():
            jax.config.update(name, value)
