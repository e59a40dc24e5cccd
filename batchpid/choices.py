"""Choices of the law that carry no number, as field-less tuples.

Being tuples without fields they are pytree nodes without leaves: static under every JAX transform, with nothing to
register, and shown by name.
"""

from __future__ import annotations

from typing import Any, NamedTuple


class Everywhere(NamedTuple):
    """Marker: an option that may be chosen per joint and env holds on all of them, so no mask is needed."""


class IntegrateFirst(NamedTuple):
    """Marker: the integral takes in the present error before the effort is computed."""


class DerivativeKick(NamedTuple):
    """Marker: the error before the first sample counts as 0, so the first derivative is a kick (peers do it)."""


class WeightFromStart(NamedTuple):
    """Marker: setpoint weighting measures positions from the first measurement instead of from 0."""


class ZeroEffort(NamedTuple):
    """Marker: a joint with a non-finite input gets effort 0."""


class HoldEffort(NamedTuple):
    """Marker: a joint with a non-finite input gets its last effort again."""


class MeasuredRate(NamedTuple):
    """Marker: the derivative takes the measured velocity, not the difference quotient of positions."""


class PerInertia(NamedTuple):
    """Marker: the gains are per unit of the joint's inertia, the diagonal of the mass matrix."""


class PerMassMatrix(NamedTuple):
    """Marker: the gains give accelerations, for the whole mass matrix to turn into efforts."""


MARKERS = (
    Everywhere,
    IntegrateFirst,
    DerivativeKick,
    WeightFromStart,
    ZeroEffort,
    HoldEffort,
    MeasuredRate,
    PerInertia,
    PerMassMatrix,
)
CHOICES: dict[str, dict[str, Any]] = {
    "integration": {"output_first": None, "integrate_first": IntegrateFirst()},
    "first_derivative": {"zero": None, "kick": DerivativeKick()},
    "weight_origin": {"zero": None, "start": WeightFromStart()},
    "non_finite": {"propagate": None, "zero": ZeroEffort(), "hold": HoldEffort()},
    "measurement_rate": {"difference": None, "measured": MeasuredRate()},
    "gain_units": {"effort": None, "inertia": PerInertia(), "mass_matrix": PerMassMatrix()},
}
"""Options chosen by name, and the marker that each name puts into the params (the first is the default)."""
