"""Types of NumPy arrays, for annotations."""

from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Bool = NDArray[np.bool_]
Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

if TYPE_CHECKING:
    import jax
    Array: TypeAlias = NDArray[Any] | jax.Array
else:
    Array = Any
"""An array of NumPy or JAX, or a value of the tracer: code that takes one runs on each of them."""

Rows = NDArray[Any]
"""An array of NumPy whose dtype is the caller's."""

ArrayModule: TypeAlias = Any
"""numpy, jax.numpy, or the tracer's functions under the same names."""

Document = dict[str, Any]
"""Keys and values of a file, a table or keyword arguments, before they are checked."""

MjModel: TypeAlias = Any
"""A mujoco.MjModel: MuJoCo is optional, and is imported where it is used."""

Kind: TypeAlias = Any
"""The type of a field, as its annotation declares it."""

DType: TypeAlias = Any
"""What ``np.dtype`` takes."""

MjSpec: TypeAlias = Any
"""A mujoco.MjSpec."""

SapienScene: TypeAlias = Any
"""A sapien.Scene, or one without a renderer: SAPIEN is optional."""

Pytree: TypeAlias = Any
"""A leaf, or a tuple, list, dict or named tuple of them, as JAX has them."""
