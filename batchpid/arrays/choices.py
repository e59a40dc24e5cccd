"""Choices of the law that carry no number, as tuples without fields.

To JAX they are pytree nodes without leaves: static under every transform, and nothing has to be
registered.
"""

from __future__ import annotations

from typing import NamedTuple

from batchpid.arrays.array_types import Document


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


class Everywhere(NamedChoice):
    """An option that may be chosen per joint and env is on for all of them, so no mask is
    needed.
    """


class ZeroEffort(NamedChoice):
    """A joint with a non-finite input gets effort 0."""


class HoldEffort(NamedChoice):
    """A joint with a non-finite input gets its last effort again."""


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
    "non_finite": {"propagate": None, "zero": ZeroEffort(), "hold": HoldEffort()},
    "measurement_rate": {"difference": None, "measured": MeasuredRate()},
    "gain_units": {"effort": None, "mass_matrix": PerMassMatrix()},
    "discretization": {"explicit": None, "implicit": ImplicitLaw()},
}
"""Options chosen by name, and what each name puts into the params; the first is the default."""
CHOICE_TYPES: tuple[type, ...] = (
    Everywhere,
    *(type(one) for named in CHOICES.values() for one in named.values() if one is not None),
)
"""Types that a choice can have in the params."""
