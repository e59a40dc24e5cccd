"""Types of NumPy arrays, for annotations."""

from types import ModuleType
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Bool = NDArray[np.bool_]
Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

# JAX is optional, and its stubs refuse operations that both libraries have.
if TYPE_CHECKING:
    import jax

    Array: TypeAlias = NDArray[Any] | jax.Array
    """An array of NumPy or JAX, or a symbol of a trace: code that takes one runs on each of them."""
else:
    Array = np.ndarray

Rows = NDArray[Any]
"""An array of NumPy whose dtype is the caller's."""

ArrayModule = ModuleType
"""numpy, jax.numpy, or the tracer's functions under the same names."""

Document = dict[str, Any]
"""Keys and values of a file, a table or keyword arguments, before they are checked."""

MjModel: TypeAlias = Any
"""A mujoco.MjModel: MuJoCo is optional, and is imported where it is used."""

Kind = object
"""The type of a field, as its annotation declares it."""

DType = type | np.dtype[Any] | str | None
"""What ``np.dtype`` takes."""

MjSpec: TypeAlias = Any
"""A mujoco.MjSpec."""

SapienScene: TypeAlias = Any
"""A sapien.Scene, or one without a renderer: SAPIEN is optional."""

Pytree: TypeAlias = Any
"""A leaf, or a tuple, list, dict or named tuple of them, as JAX has them."""
