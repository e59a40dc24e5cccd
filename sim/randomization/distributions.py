"""Distributions of the fields of a :class:`batchpid.sim.Randomization`, the joints, links or axes
that a field has values for, and the draws.
"""

from __future__ import annotations

import hashlib
import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from batchpid.arrays.array_types import Float64, Rows
from batchpid.checks import choice, flag, number
from batchpid.errors import InvalidArgumentError
from batchpid.io import documents
from batchpid.sim.description.merging import link_inertias
from batchpid.sim.description.tables import CONTACT_FRICTION, MjcfFile
from batchpid.sim.robot.robot import Robot
from batchpid.sim.signals import TWIST_UNITS

Episodes = NDArray[np.int64]
Operation = Literal["add", "scale", "abs"]
_UNIT = "in the unit of the field"
_TINY = float(np.finfo(float).tiny)
FARTHEST_SPREAD = 4.0
"""Largest distance of a normal draw from the mean, over the standard deviation: 1 in 16,000 draws
is farther.
"""
LARGEST_MEAN = 1e300
"""Largest mean and standard deviation, of which no draw is infinite."""


@dataclass(frozen=True, kw_only=True)
class Distribution(ABC):
    """Distribution of a quantity, drawn for each joint or link separately.

    Raises
    ------
    InvalidArgumentError
        An argument is out of range.
    """

    operation: Operation = "add"
    """Use of a draw: ``"add"`` it to the nominal value, ``"scale"`` that by it, or ``"abs"``: take
    it instead.
    """
    shared: bool = False
    """True for one draw for all joints or links of an env."""
    kind: ClassVar[str] = ""
    """Name in a file, where the arguments without default are a list."""

    def __post_init__(self) -> None:
        choice("operation", self.operation, get_args(Operation))
        flag("shared", self.shared)

    @property
    @abstractmethod
    def support(self) -> tuple[float, float]:
        """Smallest and largest value that can be drawn."""

    @abstractmethod
    def sample(self, generator: np.random.Generator, size: int) -> Float64:
        """Return independent draws (size,)."""

    def apply(self, nominal: Rows, drawn: Rows | float) -> Rows:
        """Return the value that results from the nominal one and a draw."""
        if self.operation == "add":
            return nominal + drawn
        if self.operation == "scale":
            return nominal * drawn
        return drawn + np.zeros_like(nominal)


@dataclass(frozen=True)
class Uniform(Distribution):
    """Uniform distribution on [low, high]."""

    low: float
    high: float
    kind = "uniform"
    least: ClassVar[float] = -math.inf
    """Least value of ``low``."""

    def __post_init__(self) -> None:
        super().__post_init__()
        low = number("low", self.low, self.least, math.inf, _UNIT)
        high = number("high", self.high, low, math.inf, _UNIT)
        # The class is frozen; its __dict__ is not.
        vars(self).update(low=low, high=high)

    @property
    def support(self) -> tuple[float, float]:
        """Smallest and largest value that can be drawn."""
        return self.low, self.high

    def sample(self, generator: np.random.Generator, size: int) -> Float64:
        """Return independent draws (size,)."""
        return generator.uniform(self.low, self.high, size)


@dataclass(frozen=True)
class LogUniform(Uniform):
    """Distribution on [low, high], both > 0, whose logarithm is uniform."""

    kind = "log_uniform"
    least = _TINY

    def sample(self, generator: np.random.Generator, size: int) -> Float64:
        """Return independent draws (size,)."""
        drawn = np.exp(generator.uniform(math.log(self.low), math.log(self.high), size))
        return np.clip(drawn, self.low, self.high)  # against rounding


@dataclass(frozen=True)
class Normal(Distribution):
    """Normal distribution; a draw further than :data:`FARTHEST_SPREAD` from the mean becomes that."""

    mean: float
    std: float
    kind = "normal"

    def __post_init__(self) -> None:
        super().__post_init__()
        mean = number("mean", self.mean, -LARGEST_MEAN, LARGEST_MEAN, _UNIT)
        std = number("std", self.std, _TINY, LARGEST_MEAN, _UNIT)
        vars(self).update(mean=mean, std=std)

    @property
    def support(self) -> tuple[float, float]:
        """Smallest and largest value that can be drawn."""
        reach = FARTHEST_SPREAD * self.std
        return self.mean - reach, self.mean + reach

    def sample(self, generator: np.random.Generator, size: int) -> Float64:
        """Return independent draws (size,)."""
        return np.clip(generator.normal(self.mean, self.std, size), *self.support)


DISTRIBUTIONS: dict[str, type[Distribution]] = {
    kind.kind: kind for kind in (Uniform, LogUniform, Normal)
}
"""Distributions by their name in a file."""


def read_distribution(name: str, value: object) -> Distribution:
    """Return the distribution of the field ``name`` that a file describes, such as ``{"uniform":
    [low, high], "operation": "scale"}``.

    Raises
    ------
    InvalidArgumentError
        It describes none.
    """
    if isinstance(value, Mapping):
        options = dict(value)
    else:
        options = {}
    problem = "is not a distribution"
    for kind, distribution in DISTRIBUTIONS.items():
        if kind not in options:
            continue
        numbers = options.pop(kind)
        if not isinstance(numbers, Sequence):
            problem = f"{kind} needs a list of numbers"
            break
        # Python names the argument that is missing, or one too many.
        try:
            with documents.named(name):
                return distribution(*numbers, **options)
        except TypeError as error:
            problem = f"is not a distribution: {error}"
        break
    remedy = f"write e.g. {{uniform: [0, 1], operation: add}}; kinds: {', '.join(DISTRIBUTIONS)}"
    raise InvalidArgumentError(name, problem, value=value, remedy=remedy)


class Draws(NamedTuple):
    """Draws for some envs."""

    episodes: Episodes
    """Stream and episode of each env (envs, 2)."""
    values: dict[str, Float64]
    """Draws by field, e.g. "payload" or "params.kp": (envs, joints or links); NaN where nothing is
    drawn.
    """

    def for_envs(self, envs: slice | Rows | Sequence[int]) -> Draws:
        """Return the draws of some envs."""
        return Draws(self.episodes[envs], {name: rows[envs] for name, rows in self.values.items()})

    def replaced(self, mask: NDArray[np.bool_], new: Draws) -> Draws:
        """Return the draws, with the envs of ``mask`` (envs,) taken from ``new``, which holds only
        these envs.
        """
        values = {name: rows.copy() for name, rows in self.values.items()}
        for name, rows in new.values.items():
            values[name][mask] = rows
        episodes = self.episodes.copy()
        episodes[mask] = new.episodes
        return Draws(episodes, values)


NOTHING = Draws(np.zeros((0, 2), np.int64), {})
"""Draws of a runner without randomization."""


def generators(
    seed: int,
    name: str,
    episodes: Episodes,
    constant: bool,
    number: ArrayLike,
) -> Iterator[np.random.Generator]:
    """Yield a generator for each env, of draw ``number`` (an int, or one for each env) of one field
    in its episode.
    """
    digest = hashlib.blake2b(name.encode(), digest_size=8).digest()
    bits = np.random.Philox(key=np.array([seed, int.from_bytes(digest, "little")], np.uint64))
    state: Any = bits.state
    generator = np.random.Generator(bits)
    numbers = np.broadcast_to(number, len(episodes)).tolist()
    for (stream, episode), index in zip(episodes.tolist(), numbers, strict=True):
        state["state"]["counter"][:] = 0, index, 0 if constant else episode, stream
        bits.state = state  # of a new generator: the buffer is empty
        yield generator


# -- fields
# --------------------------------------------------------------------------------------------------

Field = Distribution | Mapping[str, Distribution]
"""Distribution for all joints or links, or one for each of those that are named."""
FIELD_GROUPS = ("params", "actuators")
"""Fields that are mappings, by name of a further field."""
SINGLE = ("payload", "ground_friction", "push_interval", "latency")
"""Fields of one value."""
_AXES: dict[str, Sequence[str]] = {"gravity": "xyz", "push": tuple(TWIST_UNITS)}
"""Fields of the world or the base, and their axes."""


def elements(name: str, robot: Robot) -> Sequence[str]:
    """Return the names of a field's values: joints, links, axes of links or of the world, or its
    own name.
    """
    if name in SINGLE:
        return (name,)
    if name in _AXES:
        return _AXES[name]
    if name not in ("link_mass", "center_of_mass"):
        return robot.joint_names
    # A link without a stated mass has that of its shapes.
    links = list(link_inertias(robot.tables))
    if name == "link_mass":
        return links
    return [f"{link}.{axis}" for link in links for axis in "xyz"]


def parts(
    name: str, field: Field, columns: Sequence[str]
) -> Iterator[tuple[str, list[int], Distribution]]:
    """Yield the name of each independent part of a field, its columns and its distribution."""
    if isinstance(field, Distribution):
        yield name, list(range(len(columns))), field
        return
    # A link has a column for each axis of its center of mass.
    owners = list(columns)
    if name == "center_of_mass":
        owners = [column[:-2] for column in columns]
    for element, distribution in field.items():
        choice(name, element, list(dict.fromkeys(owners)))
        chosen = [index for index, owner in enumerate(owners) if owner == element]
        yield f"{name}.{element}", chosen, distribution


def nominal_values(name: str, robot: Robot, mjcf: MjcfFile | None) -> Float64:
    """Return the nominal values of a field of the robot (elements,), 0 for others.

    ``mjcf`` is the file that the engine simulates, with its own friction.
    """
    if name == "link_mass":
        inertias = link_inertias(robot.tables)
        return np.array([inertias[link].mass for link in elements(name, robot)])
    if name == "friction":
        return robot.friction
    if name == "damping":
        return robot.damping
    if name == "gravity":
        return np.array([0.0, 0.0, -9.81])
    if name == "ground_friction":
        return np.array([CONTACT_FRICTION if mjcf is None else mjcf.friction])
    return np.zeros(len(elements(name, robot)))


def mapping(name: str, value: object) -> Mapping[str, object]:
    """Return ``value`` if it is a mapping; raise InvalidArgumentError if not."""
    if not isinstance(value, Mapping):
        problem = "is not a mapping of fields to distributions"
        remedy = "write field: distribution, e.g. kp: {uniform: [0.9, 1.1], operation: scale}"
        raise InvalidArgumentError(name, problem, value=value, remedy=remedy)
    return value


def read_field(name: str, value: object) -> Field:
    """Return the field that a file describes: a distribution, or a mapping of names to
    distributions.
    """
    if isinstance(value, Mapping) and all(isinstance(part, Mapping) for part in value.values()):
        return {str(key): read_distribution(f"{name}.{key}", part) for key, part in value.items()}
    return read_distribution(name, value)
