"""Settings of JAX for the programs of batchpid, independent of the caller's settings.

JAX's debugging settings apply to a thread or a process, and thus to the programs that batchpid
compiles and calls, too. Some of them forbid operations of these programs: to take NumPy arrays as
arguments, to broadcast (joints,) to (envs, joints), and to compute with the NaN of a failed env.
The pure functions, such as :func:`batchpid.step`, run in the caller's own programs, under the
caller's settings.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from importlib.util import find_spec
from typing import Any

from batchpid.arrays.array_types import DType
from batchpid.errors import MissingDependencyError

NEEDED: dict[str, tuple[object, ...]] = {
    "jax_debug_nans": (False,),
    "jax_debug_infs": (False,),
    "jax_check_tracer_leaks": (False,),
    "jax_disable_jit": (False,),
    "jax_numpy_rank_promotion": ("allow",),
    "jax_numpy_dtype_promotion": ("standard",),
    "jax_transfer_guard_host_to_device": ("allow", None),
    "jax_transfer_guard_device_to_host": ("allow", None),
    "jax_transfer_guard_device_to_device": ("allow", None),
}
"""Accepted values of each setting; any other value is replaced by the first of them."""


def require_jax() -> None:
    """Raise MissingDependencyError if JAX is not installed. It is not imported."""
    if find_spec("jax") is None:
        raise MissingDependencyError("jax", "backend='jax'", "jax")


@contextmanager
def own_settings(dtype: DType = None) -> Iterator[None]:
    """Run a block under the settings that batchpid needs, with ``dtype`` "float64" or "float32" for
    its arrays.

    Settings with an accepted value are not touched: to enter a context for each takes longer than a
    small program.
    """
    import jax

    # Only settings that differ are entered.
    config: Any = jax.config
    others = []
    for name, values in NEEDED.items():
        if getattr(config, name) not in values:
            others.append((getattr(jax, name.removeprefix("jax_")), values[0]))
    if dtype is not None and config.jax_enable_x64 != (wide := dtype == "float64"):
        home: Any = (
            jax if hasattr(jax, "enable_x64") else jax.experimental
        )  # the latter before JAX 0.8
        others.append((home.enable_x64, wide))
    if not others:
        yield
        return
    with ExitStack() as stack:
        for context, value in others:
            stack.enter_context(context(value))
        yield
