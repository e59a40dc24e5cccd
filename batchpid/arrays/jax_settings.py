"""The precision of JAX in the programs of batchpid, whatever the caller's setting. All other
settings of JAX are the caller's.
"""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from importlib.util import find_spec
from typing import Any

from batchpid.arrays.array_types import DType
from batchpid.errors import MissingDependencyError


def require_jax() -> None:
    """Raise MissingDependencyError if JAX is not installed. It is not imported."""
    if find_spec("jax") is None:
        raise MissingDependencyError("jax", "backend='jax'", "jax")


def precision(dtype: DType) -> AbstractContextManager[None]:
    """Return a context in which JAX has arrays of ``dtype``, "float64" or "float32"; None: as the
    caller has set it.
    """
    import jax

    config: Any = jax.config
    is_wide = dtype == "float64"
    # To enter a context takes longer than a small program.
    if dtype is None or config.jax_enable_x64 == is_wide:
        return nullcontext()
    # Before JAX 0.8 it is in another module.
    home: Any = jax if hasattr(jax, "enable_x64") else jax.experimental
    context: AbstractContextManager[None] = home.enable_x64(is_wide)
    return context
