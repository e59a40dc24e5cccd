"""Unknowns of a fit: objects with a start, a typical size and a prior, and the candidates at their
values.

A positive unknown x of typical size s has the coordinate c with x / s = (c + sqrt(c^2 + 4 r^2)) / 2
in place of a bound: x / s itself, but for values near zero. Efforts are linear in most unknowns, so
that a logarithm would bend the valleys between them. The coordinate of the others is x / s.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress
from typing import Literal, NamedTuple

import numpy as np

from batchpid.arrays.array_types import Bool, Float64
from batchpid.motors.actuators import Actuators
from batchpid.sim.identification.simulator import PAYLOAD, PlantCandidates
from batchpid.sim.robot.robot import Robot

ROUND = 0.03
"""Value of a positive unknown, over its typical size, at which its coordinate is 0."""
LEAST_START = 0.02
"""Least start of a positive unknown, over its typical size: at zero there is no slope."""


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
    """Field of :class:`batchpid.Actuators`."""
    positive: bool = True
    most: float = np.inf
    """Largest value."""


KINDS = {
    "armature": Kind("motor", "joint", "inertia", 4.0, field="armature"),
    "damping": Kind("motor", "joint", "damping", 4.0, field="viscous"),
    "friction": Kind("motor", "joint", "effort", 4.0, field="coulomb"),
    "strength": Kind("motor", "joint", 1.0, 0.3, 1.0, "strength"),
    "effort_scale": Kind("sensor", "joint", 1.0, 0.3, 1.0, "strength"),
    "bias": Kind("motor", "joint", "effort", 10.0, field="bias", positive=False),
    "delay": Kind("motor", "robot", 2e-3, 3.0, field="command_delay", most=0.1),
    "setpoint_delay": Kind("setpoint", "robot", 5e-3, 10.0, most=0.2),
    "payload": Kind("robot", "robot", 0.1, 4.0),
    "load_friction": Kind("motor", "joint", 0.05, 2.0, field="load_friction", most=0.9),
    "static": Kind("motor", "joint", "friction", 2.0, field="static"),
    "stribeck": Kind("motor", "joint", "speed", 2.0, field="stribeck"),
    "offset": Kind("motor", "joint", 0.01, 20.0, field="position_offset", positive=False),
    "gain": Kind("law", "joint", 1.0, 3.0, 1.0),
    "kd": Kind("law", "joint", 1.0, 2.0, 1.0),
    "saturation": Kind("law", "joint", "error", 2.0, np.inf),
    "slew": Kind("law", "joint", "top_speed", 2.0, np.inf),
    "mass": Kind("robot", "link", 1.0, 0.05, 1.0),
}
"""Kinds of unknowns. "effort_scale" is the scale of measured efforts, "static" the friction at rest
in addition to "friction", "stribeck" the speed at which half of it is left. "gain" is a factor of
all gains of the law, "kd" of kd alone, "saturation" the law's effort limit over its kp [rad or m],
"slew" the limit of the setpoints' rate, "mass" a factor of a link's mass and inertia.
"""
BASIC = ("armature", "damping", "friction", "strength", "bias", "delay")
"""Kinds that every fit has."""
EXTRAS = ("load_friction", "stribeck", "offset", "mass", "gain", "kd", "saturation", "slew")
"""Kinds that a fit has on request; "stribeck" brings "static" with it."""
DESCRIBED = {"damping": "damping", "friction": "friction"}
"""Kinds that add to a value of the robot's description, and the name there."""


class Unknown(NamedTuple):
    """One unknown."""

    kind: str
    joint: int | None
    """Number of its joint among the logged ones; None for an unknown of the whole robot or of a
    link.
    """
    start: float
    size: float
    link: str | None = None


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Unknowns of the logged ``joints`` of ``robot``; points are their coordinates (unknowns,).

    Values are in addition to the robot's description.
    """

    robot: Robot
    joints: tuple[int, ...]
    entries: tuple[Unknown, ...]

    @classmethod
    def of(
        cls,
        robot: Robot,
        joints: tuple[int, ...],
        kinds: Sequence[str],
        starts: Mapping[str, Float64],
        sizes: Mapping[str, Float64],
        links: Sequence[str],
    ) -> Unknowns:
        """Return the unknowns of ``kinds``.

        ``starts`` (joints,) or (1,) are values of some kinds, with the description's, others begin
        at their typical size. ``sizes`` (joints,) are typical values by name.
        """
        entries = list[Unknown]()
        for name in kinds:
            kind = KINDS[name]
            if kind.per == "link":
                entries += [Unknown(name, None, 1.0, 1.0, link) for link in links]
                continue
            for joint in range(len(joints)) if kind.per == "joint" else (None,):
                column = joint or 0
                size = sizes[kind.size][column] if isinstance(kind.size, str) else kind.size
                start = size * kind.positive
                if name in starts:
                    start = starts[name][column]
                if name in DESCRIBED:
                    start -= getattr(robot, DESCRIBED[name])[joints[column]]
                if kind.positive:
                    start = max(start, LEAST_START * size)
                entries.append(Unknown(name, joint, float(start), float(size)))
        return cls(robot, joints, tuple(entries))

    @cached_property
    def kinds(self) -> list[Kind]:
        """Kind of each unknown."""
        return [KINDS[entry.kind] for entry in self.entries]

    @cached_property
    def sizes(self) -> Float64:
        """Typical sizes (unknowns,)."""
        return np.array([entry.size for entry in self.entries])

    @cached_property
    def spread(self) -> Float64:
        """Standard deviations of the prior over the sizes (unknowns,)."""
        return np.array([kind.spread for kind in self.kinds])

    @cached_property
    def positive(self) -> Bool:
        """Mask (unknowns,) of the unknowns that are positive."""
        return np.array([kind.positive for kind in self.kinds], bool)

    @cached_property
    def _late(self) -> Float64:
        """Parts (unknowns, unknowns) of values in coordinates of others.

        The coordinate of a delay of setpoints holds for the sum with that of efforts: logs show the
        sum far better than its parts, and a fit follows a valley that is straight.
        """
        names = np.array([entry.kind for entry in self.entries], dtype=object)
        return np.outer(names == "delay", (names == "setpoint_delay") / self.sizes)

    @property
    def start(self) -> Float64:
        """Point at the start of a fit."""
        return self.points(np.array([entry.start for entry in self.entries]))

    @property
    def prior(self) -> tuple[Float64, Float64]:
        """Means and standard deviations (unknowns,) of the prior, coordinates.

        The mean is that of ideal motors for strengths, factors and signed unknowns, else the start.
        """
        pairs = zip(self.kinds, self.entries, strict=True)
        means = np.array([1.0 if kind.neutral == 1.0 else entry.start for kind, entry in pairs])
        mean = self._coordinates(means * self.positive)
        return mean, self.spread * np.maximum(mean, 1.0)

    def _coordinates(self, values: Float64) -> Float64:
        """Return the coordinates of values (..., unknowns), one by one."""
        shares = values / self.sizes
        least = np.maximum(shares, 0.1 * ROUND)
        return np.where(self.positive, least - ROUND**2 / least, shares)

    def points(self, values: Float64) -> Float64:
        """Return the points (..., unknowns) of ``values`` (..., unknowns)."""
        return self._coordinates(values) + values @ self._late

    def values(self, points: Float64) -> Float64:
        """Return the values (..., unknowns) at ``points`` (..., unknowns)."""
        most = [kind.most for kind in self.kinds]

        def alone(points: Float64) -> Float64:
            rounded = 0.5 * (points + np.sqrt(points**2 + 4 * ROUND**2))
            return np.minimum(self.sizes * np.where(self.positive, rounded, points), most)

        return alone(points - alone(points) @ self._late)

    def tables(self, values: Float64, *targets: str) -> dict[str, Float64]:
        """Return the ``values`` (n, unknowns) of kinds that change one of ``targets`` as tables (n,
        joints), by field of actuators or kind.
        """
        tables = dict[str, Float64]()
        for column, (kind, entry) in enumerate(zip(self.kinds, self.entries, strict=True)):
            if kind.target in targets:
                neutral = np.full((len(values), len(self.joints)), kind.neutral)
                table = tables.setdefault(kind.field or entry.kind, neutral)
                joint = slice(None) if entry.joint is None else [entry.joint]
                table[:, joint] = values[:, column, None]
        # An unknown of friction at rest is in addition to friction in motion.
        if "static" in tables:
            tables["static"] += tables.get("coulomb", 0.0)
        return tables

    def candidates(self, values: Float64) -> PlantCandidates:
        """Return the candidates with ``values`` (n, unknowns)."""
        fields = self.tables(values, "motor", "sensor")
        if "command_delay" in fields:
            fields["max_delay"] = fields["command_delay"].max(keepdims=True)
        late = self.tables(values, "setpoint").get("setpoint_delay", np.zeros((len(values), 1)))
        robots = [at for at, kind in enumerate(self.kinds) if kind.target == "robot"]
        names = [self.entries[at].link or PAYLOAD for at in robots]
        masses = [tuple(zip(names, row, strict=True)) for row in values[:, robots].tolist()]
        law = self.tables(values, "law")
        return PlantCandidates(Actuators(**fields), law, late[:, 0], masses)

    def only(self, mask: Bool) -> Unknowns:
        """Return the unknowns of a mask (unknowns,); the others have their neutral value."""
        return replace(self, entries=tuple(compress(self.entries, mask)))
