"""Unknowns of a fit: objects with a start, a typical size and a prior, and the candidates at their
values.

A positive unknown x of typical size s is fitted as log(x / s), in place of bounds; others as x / s.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from batchpid.arrays.array_types import Bool, Float64
from batchpid.motors.actuators import Actuators
from batchpid.sim.identification.simulator import PAYLOAD, PlantCandidates
from batchpid.sim.robot.robot import Robot

FARTHEST = 7.0
"""Largest distance of a logarithm from its start: there the slope ends."""


LEAST_START = 0.02
"""Least start of a positive unknown, over its typical size: further down its logarithm has no
slope.
"""


class Kind(NamedTuple):
    """Kind of unknown, in SI units."""

    target: Literal["motor", "law", "robot", "log"]
    """Part of a candidate that it changes."""
    per: Literal["joint", "robot", "link"]
    size: str | float
    """Typical size: a number, or the name of a typical value of each joint."""
    spread: float
    """Standard deviation of the prior: of the logarithm, or over the typical size."""
    neutral: float = 0.0
    """Value without effect."""
    field: str = ""
    """Field of :class:`batchpid.Actuators`, for a motor."""
    positive: bool = True
    most: float = np.inf
    """Largest value."""


KINDS = {
    "armature": Kind("motor", "joint", "inertia", 4.0, field="armature"),
    "damping": Kind("motor", "joint", "damping", 4.0, field="viscous"),
    "friction": Kind("motor", "joint", "effort", 4.0, field="coulomb"),
    "strength": Kind("motor", "joint", 1.0, 0.3, 1.0, "strength"),
    "bias": Kind("motor", "joint", "effort", 10.0, field="bias", positive=False),
    "delay": Kind("motor", "robot", 2e-3, 3.0, field="command_delay", most=0.1),
    "setpoint_delay": Kind("log", "robot", 5e-3, 3.0, most=0.3),
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
"""Kinds of unknowns. "static" is the friction at rest in addition to "friction", "stribeck" the
speed at which half of it is left. "gain" is a factor of all gains of the law, "kd" of kd alone,
"saturation" the law's effort limit over its kp [rad or m], "slew" the limit of the setpoints' rate,
"mass" a factor of a link's mass and inertia.
"""
BASIC = ("armature", "damping", "friction", "strength", "bias", "delay")
"""Kinds that every fit has."""
EXTRAS = {
    "load_friction": ("load_friction",),
    "stribeck": ("static", "stribeck"),
    "offset": ("offset",),
    "mass": ("mass",),
    "gain": ("gain",),
    "kd": ("kd",),
    "saturation": ("saturation",),
    "slew": ("slew",),
}
"""Kinds that a fit has on request."""
LAW = ("gain", "kd", "saturation", "slew")
"""Extras of a law."""
DESCRIBED = {"damping": "damping", "friction": "friction"}
"""Kinds to which the robot's description contributes, and the name there. Values of a fit include
that part.
"""


@dataclass(frozen=True)
class Unknown:
    """One unknown."""

    kind: str
    joint: int | None
    """Number of its joint among the logged ones; None for an unknown of the whole robot or of a
    link.
    """
    start: float
    size: float
    floor: float = 0.0
    """Part of the value that the robot's description has."""
    link: str | None = None

    @property
    def spread(self) -> float:
        """Standard deviation of the prior, in the coordinate of the fit."""
        return KINDS[self.kind].spread

    def coordinate(self, value: float) -> float:
        """Return the coordinate of a value in the fit."""
        if not KINDS[self.kind].positive:
            return value / self.size
        return float(np.log(max(value - self.floor, 1e-3 * self.size) / self.size))

    def values(self, coordinates: Float64) -> Float64:
        """Return the values at some coordinates."""
        if not KINDS[self.kind].positive:
            return coordinates * self.size
        begin = self.coordinate(self.start)
        values = self.floor + self.size * np.exp(
            np.clip(coordinates, begin - FARTHEST, begin + FARTHEST)
        )
        return np.minimum(values, KINDS[self.kind].most)


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Unknowns of the logged ``joints`` of ``robot``; points are their coordinates (unknowns,)."""

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

        ``starts`` (joints,) or (1,) are values of some kinds, others begin at their typical size.
        ``sizes`` (joints,) are typical values by name. A positive unknown begins at
        :data:`LEAST_START` of its typical size at least.
        """
        entries = list[Unknown]()
        for name in kinds:
            kind = KINDS[name]
            if kind.per == "link":
                entries += [Unknown(name, None, 1.0, 1.0, link=link) for link in links]
                continue
            numbers: Sequence[int | None] = range(len(joints)) if kind.per == "joint" else (None,)
            for joint in numbers:
                size = (
                    float(sizes[kind.size][joint or 0]) if isinstance(kind.size, str) else kind.size
                )
                start = (
                    float(starts[name][joint or 0])
                    if name in starts
                    else size
                    if kind.positive
                    else 0.0
                )
                floor = (
                    0.0
                    if name not in DESCRIBED
                    else getattr(robot, DESCRIBED[name])[joints[joint or 0]]
                )
                start = max(start, floor + LEAST_START * size) if kind.positive else start
                entries.append(Unknown(name, joint, start, size, float(floor)))
        return cls(robot, joints, tuple(entries))

    @property
    def start(self) -> Float64:
        """Point at the start of a fit."""
        return np.array([entry.coordinate(entry.start) for entry in self.entries])

    @property
    def prior(self) -> Float64:
        """Mean of the prior: ideal motors for strengths, factors and signed unknowns, else the
        start.
        """
        means = [KINDS[entry.kind].neutral for entry in self.entries]
        return np.array(
            [
                entry.coordinate(
                    mean if mean == 1.0 or not KINDS[entry.kind].positive else entry.start
                )
                for entry, mean in zip(self.entries, means, strict=True)
            ]
        )

    @property
    def spread(self) -> Float64:
        """Standard deviations of the prior."""
        return np.array([entry.spread for entry in self.entries])

    def values(self, points: Float64) -> Float64:
        """Return the values (n, unknowns) at ``points`` (n, unknowns)."""
        columns = [entry.values(points[:, at]) for at, entry in enumerate(self.entries)]
        return np.stack(columns, axis=1) if columns else points

    def tables(self, values: Float64) -> dict[str, Float64]:
        """Return the values (n, joints) of all kinds of motor, law and log, by kind; neutral or
        described elsewhere.
        """
        count, tables = len(values), dict[str, Float64]()
        for name, described in DESCRIBED.items():
            row = getattr(self.robot, described)[list(self.joints)]
            if row.any():
                tables[name] = np.tile(row, (count, 1)).astype(float)
        for at, entry in enumerate(self.entries):
            kind = KINDS[entry.kind]
            if kind.per == "link" or entry.kind == "payload":
                continue
            table = tables.setdefault(entry.kind, np.full((count, len(self.joints)), kind.neutral))
            columns = slice(None) if entry.joint is None else slice(entry.joint, entry.joint + 1)
            table[:, columns] = values[:, at : at + 1]
        return tables

    def candidates(self, values: Float64) -> PlantCandidates:
        """Return the candidates with ``values`` (n, unknowns)."""
        tables = self.tables(values)
        fields = {
            KINDS[name].field: table
            for name, table in tables.items()
            if KINDS[name].target == "motor"
        }
        if "static" in fields:
            fields["static"] = fields["static"] + fields["coulomb"]
        longest = np.array([[fields["command_delay"].max()]]) if "command_delay" in fields else None
        heavy = {
            at: entry.link or PAYLOAD
            for at, entry in enumerate(self.entries)
            if entry.kind in ("payload", "mass")
        }
        masses = tuple(
            tuple((link, float(row[at])) for at, link in heavy.items()) for row in values
        )
        delay = (
            tables["setpoint_delay"][:, 0] if "setpoint_delay" in tables else np.zeros(len(values))
        )
        law = {name: table for name, table in tables.items() if KINDS[name].target == "law"}
        return PlantCandidates(Actuators(**fields, max_delay=longest), law, delay, masses)

    def only(self, mask: Bool) -> Unknowns:
        """Return the unknowns of a mask (unknowns,); the others have their neutral value."""
        entries = tuple(entry for entry, stays in zip(self.entries, mask, strict=True) if stays)
        return Unknowns(self.robot, self.joints, entries)
