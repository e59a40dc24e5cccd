"""Types of arrays, for annotations, and choices: leaves of the law that carry no number.

Choices are tuples without fields. To JAX they are pytree nodes without leaves: static under every
transform, and nothing has to be registered.
"""

from collections.abc import Callable, Iterable
from types import ModuleType
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias, TypeVar

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


class NamedChoice(NamedTuple):
    """Base of choices. Equality depends on the type: as keys of a cache, plain empty tuples would
    all be equal.
    """

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other)

    def __ne__(self, other: object) -> bool:
        return type(self) is not type(other)

    def __hash__(self) -> int:
        return hash(type(self))


class Clamp(NamedChoice):
    """The integral is limited, to the effort limits unless it has its own."""


class Conditional(NamedChoice):
    """The integral does not grow further into saturation."""


class BackCalculation(NamedChoice):
    """The integral follows the saturated effort."""


class MeasuredRate(NamedChoice):
    """The derivative takes the measured velocity instead of the difference quotient of
    positions.
    """


class PerMassMatrix(NamedChoice):
    """Gains per unit of inertia: the law returns an acceleration, which the mass matrix turns into
    an effort.
    """


class ImplicitLaw(NamedChoice):
    """P, I and D act on position and velocity at the end of the step, which the law predicts."""


CHOICES: dict[str, Document] = {
    "anti_windup": {
        "none": None,
        "clamp": Clamp(),
        "conditional": Conditional(),
        "back_calculation": BackCalculation(),
    },
    "measurement_rate": {"difference": None, "measured": MeasuredRate()},
    "gain_units": {"effort": None, "mass_matrix": PerMassMatrix()},
    "discretization": {"explicit": None, "implicit": ImplicitLaw()},
}
"""Options chosen by name, and what each name puts into the params; the first is the default."""
CHOICE_TYPES: tuple[type, ...] = tuple(
    type(one) for named in CHOICES.values() for one in named.values() if one is not None
)
"""Types that a choice can have in the params."""
