"""Types of NumPy arrays, for annotations."""

from collections.abc import Callable, Iterable
from types import ModuleType
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

Bool = NDArray[np.bool_]
Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

# JAX is optional, and its stubs refuse operations that both libraries have.
if TYPE_CHECKING:
    import jax
    from mujoco import MjData as MjData
    from mujoco import MjModel as MjModel
    from mujoco import MjsBody as MjsBody
    from mujoco import MjSpec as MjSpec

    Array: TypeAlias = NDArray[Any] | jax.Array
    """An array of NumPy or JAX, or a symbol of a trace: code that takes one runs on each of them."""
else:
    # MuJoCo is imported where it is used.
    Array = np.ndarray
    MjData = MjModel = MjsBody = MjSpec = object

Rows = NDArray[Any]
"""An array of NumPy whose dtype is the caller's."""

ArrayModule = ModuleType
"""numpy, jax.numpy, or the tracer's functions under the same names."""

Document = dict[str, Any]
"""Keys and values of a file, a table or keyword arguments, before they are checked."""

Kind = object
"""The type of a field, as its annotation declares it."""

DType = type | np.dtype[Any] | str | None
"""What ``np.dtype`` takes."""

T = TypeVar("T")
Progress = Callable[[Iterable[T]], Iterable[T]]
"""Wraps the rounds of a long call, e.g. ``tqdm.tqdm``."""

Pytree: TypeAlias = Any
"""A leaf, or a tuple, list, dict or named tuple of them, as JAX has them."""
