"""Unknowns of a fit: objects with a start, a typical size, bounds and a prior, and the candidates
at their values.

A point has the values over their typical sizes. Bounds hold for the sum with the robot's
description: what adds to its friction and damping may be negative.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress
from typing import Any, Literal, NamedTuple

import numpy as np

from batchpid.arrays.array_types import Bool, Float64
from batchpid.motors.actuators import Actuators
from batchpid.sim.identification.simulator import Candidates
from batchpid.sim.robot.robot import Robot


class Kind(NamedTuple):
    """Kind of unknown, in SI units."""

    target: Literal["motor", "law", "robot", "sensor", "setpoint"]
    """Part of a candidate that it changes. Only motors become actuators."""
    per: Literal["joint", "robot", "link"]
    size: str | float
    """Typical size: a number, or the name of a typical value of each joint."""
    spread: float
    """Standard deviation of the prior, over the typical size or the start, if that is larger."""
    neutral: float = 0.0
    """Value without effect."""
    field: str = ""
    """Field of :class:`batchpid.Actuators`, where it has another name."""
    least: float = 0.0
    """Least value."""
    most: float = np.inf
    """Largest value."""

    @property
    def is_positive(self) -> bool:
        """Whether there are no negative values."""
        return self.least >= 0


UNKNOWN_KINDS = {
    "armature": Kind("motor", "joint", "inertia", 4.0),
    "damping": Kind("motor", "joint", "damping", 4.0, field="viscous"),
    "friction": Kind("motor", "joint", "effort", 4.0, field="coulomb"),
    "strength": Kind(
        "motor",
        "joint",
        1.0,
        0.3,
        1.0,
        least=1e-3,
    ),
    "effort_scale": Kind(
        "sensor",
        "joint",
        1.0,
        0.3,
        1.0,
        "strength",
        1e-3,
    ),
    "bias": Kind(
        "motor",
        "joint",
        "effort",
        10.0,
        least=-np.inf,
    ),
    "delay": Kind(
        "motor",
        "robot",
        2e-3,
        3.0,
        field="command_delay",
        most=0.1,
    ),
    "setpoint_delay": Kind("setpoint", "robot", 5e-3, 10.0, most=0.2),
    "setpoint_lag": Kind("setpoint", "robot", 5e-3, 10.0, most=0.5),
    "payload": Kind("robot", "robot", 0.1, 10.0),
    "load_friction": Kind(
        "motor",
        "joint",
        0.05,
        2.0,
        most=0.9,
    ),
    "static": Kind("motor", "joint", "friction", 2.0),
    "stribeck": Kind("motor", "joint", "speed", 2.0),
    "offset": Kind(
        "motor",
        "joint",
        0.01,
        20.0,
        field="position_offset",
        least=-np.inf,
    ),
    "gain": Kind("law", "joint", 1.0, 3.0, 1.0),
    "kd": Kind("law", "joint", 1.0, 2.0, 1.0),
    "saturation": Kind("law", "joint", "error", 2.0, np.inf),
    "slew": Kind("law", "joint", "top_speed", 2.0, np.inf),
    # A body without any mass has no center.
    "mass": Kind(
        "robot",
        "link",
        1.0,
        0.3,
        1.0,
        least=1e-3,
    ),
}
"""Kinds of unknowns. "effort_scale" is the scale of measured efforts, "static" the friction at rest
in addition to "friction", "stribeck" the speed at which half of it is left. "gain" is a factor of
all gains of the law, "kd" of kd alone, "saturation" the law's effort limit over its kp [rad or m],
"slew" the limit of the setpoints' rate, "mass" a factor of a link's mass and inertia. The delay and
the first-order lag of setpoints belong to their sender.
"""
BASIC = ("armature", "damping", "friction", "strength", "bias", "delay")
"""Kinds that every fit has."""
EXTRAS = ("load_friction", "stribeck", "offset", "mass", "gain", "kd", "saturation", "slew")
"""Kinds that a fit has on request; "stribeck" brings "static" with it."""
SENDER = ("setpoint_delay", "setpoint_lag")
"""Kinds that every fit of setpoints has in addition."""
DESCRIBED = ("damping", "friction")
"""Kinds that add to a value of the robot's description, which has the same name."""


def kinds_of(effect: str) -> list[str]:
    """Return the kinds of unknowns of an effect that a fit has on request."""
    return ["static", effect] if effect == "stribeck" else [effect]


class Unknown(NamedTuple):
    """One unknown."""

    kind: str
    place: int | str | None
    """Number of its joint among the logged ones, or link of a mass; None for the whole robot."""
    start: float
    size: float
    least: float
    """Least value."""


def least_value(robot: Robot, kind: str, joint: int) -> float:
    """Return the least value of an unknown of a joint of ``robot``; with the description's it is
    zero.
    """
    return -float(getattr(robot, kind)[joint]) if kind in DESCRIBED else UNKNOWN_KINDS[kind].least


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Unknowns of the logged ``joints`` of ``robot``; points are values over typical sizes
    (unknowns,).

    Values are in addition to the robot's description.
    """

    robot: Robot
    joints: tuple[int, ...]
    typical: Mapping[str, Float64]
    """Typical values (joints,) by name."""
    links: Sequence[str]
    """Links whose masses can be unknown."""
    payload_link: str | None = None
    entries: tuple[Unknown, ...] = ()

    def adding(self, kinds: Sequence[str], starts: Mapping[str, Float64]) -> Unknowns:
        """Return these and the unknowns of ``kinds``.

        ``starts`` (joints,) or (1,) are values of some kinds, with the description's; others begin
        at their typical size.
        """
        entries = list(self.entries)
        places: dict[str, Sequence[Any]] = {"joint": range(len(self.joints)), "robot": [None]}
        places["link"] = self.links
        for name in kinds:
            kind = UNKNOWN_KINDS[name]
            for place in places[kind.per]:
                column = place if isinstance(place, int) else 0
                size = kind.size
                if isinstance(size, str):
                    size = float(self.typical[size][column])
                least = least_value(self.robot, name, self.joints[column])
                start = size * kind.is_positive
                if name in starts:
                    start = float(starts[name][column])
                if name in DESCRIBED:
                    start += least
                entries.append(
                    Unknown(
                        name,
                        place,
                        max(start, least),
                        size,
                        least,
                    )
                )
        return replace(self, entries=tuple(entries))

    @cached_property
    def kinds(self) -> list[Kind]:
        """Kind of each unknown."""
        return [UNKNOWN_KINDS[entry.kind] for entry in self.entries]

    @cached_property
    def sizes(self) -> Float64:
        """Typical sizes (unknowns,)."""
        return np.array([entry.size for entry in self.entries])

    @cached_property
    def bounds(self) -> tuple[Float64, Float64]:
        """Least and largest point."""
        least = np.array([entry.least for entry in self.entries])
        return least / self.sizes, np.array([kind.most for kind in self.kinds]) / self.sizes

    @property
    def start(self) -> Float64:
        """Point at the start of a fit."""
        return np.array([entry.start for entry in self.entries]) / self.sizes

    @property
    def prior(self) -> tuple[Float64, Float64]:
        """Means and standard deviations (unknowns,) of the prior of a point.

        The mean is that of ideal motors for strengths, factors and signed unknowns, else the start.
        """
        means = []
        for kind, entry in zip(self.kinds, self.entries, strict=True):
            means.append(1.0 if kind.neutral == 1.0 else entry.start * kind.is_positive)
        mean = np.array(means) / self.sizes
        return mean, self.spread(mean)

    def spread(self, point: Float64) -> Float64:
        """Return the standard deviations (unknowns,) of the prior around a ``point``."""
        return np.array([kind.spread for kind in self.kinds]) * np.maximum(np.abs(point), 1.0)

    def values(self, points: Float64) -> Float64:
        """Return the values (..., unknowns) at ``points`` (..., unknowns)."""
        return points * self.sizes

    @cached_property
    def described(self) -> Float64:
        """Values of the robot's description (unknowns,), which add to those here."""
        return np.array(
            [-entry.least if entry.kind in DESCRIBED else 0.0 for entry in self.entries]
        )

    def tables(self, values: Float64, *targets: str) -> dict[str, Float64]:
        """Return the ``values`` (n, unknowns) of kinds that change one of ``targets`` as tables (n,
        joints), by field of actuators or kind.
        """
        tables = dict[str, Float64]()
        for column, (kind, entry) in enumerate(zip(self.kinds, self.entries, strict=True)):
            if kind.target in targets:
                neutral = np.full((len(values), len(self.joints)), kind.neutral)
                table = tables.setdefault(kind.field or entry.kind, neutral)
                joint: Any = slice(None) if entry.place is None else [entry.place]
                table[:, joint] = values[:, column, None]
        # An unknown of friction at rest is in addition to friction in motion.
        if "static" in tables:
            tables["static"] += tables.get("coulomb", 0.0)
        return tables

    def candidates(self, values: Float64) -> Candidates:
        """Return the candidates with ``values`` (n, unknowns)."""
        fields = self.tables(values, "motor", "sensor")
        if "command_delay" in fields:
            fields["max_delay"] = fields["command_delay"].max(keepdims=True)
        none = np.zeros((len(values), 1))
        sender = self.tables(values, "setpoint")
        late, lag = (sender.get(name, none)[:, 0] for name in SENDER)
        masses: dict[str, dict[Any, Float64]] = {"payload": {}, "mass": {}}
        for column, entry in enumerate(self.entries):
            if entry.kind in masses:
                masses[entry.kind][entry.place or self.payload_link] = values[:, column]
        law = self.tables(values, "law")
        return Candidates(Actuators(**fields), law, late, lag, **masses)

    def only(self, mask: Bool) -> Unknowns:
        """Return the unknowns of a mask (unknowns,); the others have their neutral value."""
        return replace(self, entries=tuple(compress(self.entries, mask)))
