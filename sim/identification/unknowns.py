"""Unknowns of a fit: objects with a start, a typical size and a prior, and the candidates at their
values.

A positive unknown x of typical size s has the coordinate c with x / s = (c + sqrt(c^2 + 4 r^2)) / 2
in place of a bound: x / s itself, but for values near zero. Efforts are linear in most unknowns, so
that a logarithm would bend the valleys between them. The coordinate of the others is x / s.
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

ROUND = 0.03
"""Value of a positive unknown, over its typical size, at which its coordinate is 0."""
LEAST_START = 0.02
"""Least start of a positive unknown, over its typical size: at zero there is no slope."""


class Kind(NamedTuple):
    """Kind of unknown, in SI units."""

    target: Literal["motor", "law", "robot", "log"]
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
    "effort_scale": Kind("log", "joint", 1.0, 0.3, 1.0, "strength"),
    "bias": Kind("motor", "joint", "effort", 10.0, field="bias", positive=False),
    "delay": Kind("motor", "robot", 2e-3, 3.0, field="command_delay", most=0.1),
    "setpoint_delay": Kind("log", "robot", 5e-3, 10.0, most=0.2),
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
    def prior(self) -> tuple[float, float]:
        """Mean and standard deviation of the prior, coordinates.

        The mean is that of ideal motors for strengths, factors and signed unknowns, else the start.
        """
        kind = KINDS[self.kind]
        if not kind.positive:
            return 0.0, kind.spread
        mean = self.coordinate(kind.neutral if kind.neutral == 1.0 else self.start)
        return mean, kind.spread * max(mean, 1.0)

    def coordinate(self, value: float) -> float:
        """Return the coordinate of a value in the fit."""
        share = (value - self.floor) / self.size
        if not KINDS[self.kind].positive:
            return share
        share = max(share, 0.1 * ROUND)
        return share - ROUND**2 / share

    def values(self, coordinates: Float64) -> Float64:
        """Return the values at some coordinates."""
        shares = coordinates
        if KINDS[self.kind].positive:
            shares = 0.5 * (coordinates + np.sqrt(coordinates**2 + 4 * ROUND**2))
        return np.minimum(self.floor + self.size * shares, KINDS[self.kind].most)


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
        ``sizes`` (joints,) are typical values by name.
        """
        entries = list[Unknown]()
        for name in kinds:
            kind = KINDS[name]
            if kind.per == "link":
                entries += [Unknown(name, None, 1.0, 1.0, link=link) for link in links]
                continue
            for joint in range(len(joints)) if kind.per == "joint" else (None,):
                column = joint or 0
                size = sizes[kind.size][column] if isinstance(kind.size, str) else kind.size
                floor = 0.0
                if name in DESCRIBED:
                    floor = getattr(robot, DESCRIBED[name])[joints[column]]
                start = size * kind.positive
                if name in starts:
                    start = starts[name][column]
                if kind.positive:
                    start = max(start, floor + LEAST_START * size)
                entries.append(Unknown(name, joint, float(start), float(size), float(floor)))
        return cls(robot, joints, tuple(entries))

    @property
    def start(self) -> Float64:
        """Point at the start of a fit."""
        values = np.array([[entry.start for entry in self.entries]])
        return self.points(values).reshape(-1)

    @property
    def prior(self) -> Float64:
        """Means and standard deviations of the prior (2, unknowns)."""
        rows = [entry.prior for entry in self.entries]
        return np.array(rows, dtype=np.float64).reshape(-1, 2).T

    def values(self, points: Float64) -> Float64:
        """Return the values (n, unknowns) at ``points`` (n, unknowns).

        The coordinate of a delay of setpoints holds for the sum with that of efforts: logs show the
        sum far better than its parts, and a fit follows a valley that is straight.
        """
        values = np.array(points)
        delay = np.zeros(len(points))
        for column, entry in enumerate(self.entries):
            coordinate = points[:, column]
            if entry.kind == "setpoint_delay":
                coordinate = coordinate - delay / entry.size
            values[:, column] = entry.values(coordinate)
            if entry.kind == "delay":
                delay = values[:, column]
        return values

    def points(self, values: Float64) -> Float64:
        """Return the coordinates (n, unknowns) of ``values`` (n, unknowns)."""
        points = np.array(values)
        delay = np.zeros(len(values))
        for column, entry in enumerate(self.entries):
            points[:, column] = [entry.coordinate(value) for value in values[:, column]]
            if entry.kind == "setpoint_delay":
                points[:, column] += delay / entry.size
            if entry.kind == "delay":
                delay = values[:, column]
        return points

    def tables(self, values: Float64) -> dict[str, Float64]:
        """Return the values (n, joints) of all kinds but masses, by kind; neutral or described
        elsewhere.
        """
        tables = dict[str, Float64]()
        shape = len(values), len(self.joints)
        for name, described in DESCRIBED.items():
            row = getattr(self.robot, described)[list(self.joints)]
            if row.any():
                tables[name] = np.tile(row, (len(values), 1)).astype(float)
        for column, entry in enumerate(self.entries):
            kind = KINDS[entry.kind]
            if kind.target != "robot":
                table = tables.setdefault(entry.kind, np.full(shape, kind.neutral))
                where = slice(None) if entry.joint is None else slice(entry.joint, entry.joint + 1)
                table[:, where] = values[:, column, None]
        return tables

    def candidates(self, values: Float64) -> PlantCandidates:
        """Return the candidates with ``values`` (n, unknowns)."""
        law = {}
        fields = {}
        setpoint_delay = np.zeros(len(values))
        for name, table in self.tables(values).items():
            if KINDS[name].target == "law":
                law[name] = table
            elif name == "setpoint_delay":
                setpoint_delay = table[:, 0]
            else:
                fields[KINDS[name].field] = table
        if "static" in fields:
            fields["static"] = fields["static"] + fields.get("coulomb", 0.0)
        if "command_delay" in fields:
            fields["max_delay"] = fields["command_delay"].max(keepdims=True)
        masses = [list[tuple[str, float]]() for _ in values]
        for column, entry in enumerate(self.entries):
            if KINDS[entry.kind].target == "robot":
                for row, value in zip(masses, values[:, column].tolist(), strict=True):
                    row.append((entry.link or PAYLOAD, value))
        return PlantCandidates(Actuators(**fields), law, setpoint_delay, list(map(tuple, masses)))

    def only(self, mask: Bool) -> Unknowns:
        """Return the unknowns of a mask (unknowns,); the others have their neutral value."""
        entries = tuple(entry for entry, stays in zip(self.entries, mask, strict=True) if stays)
        return Unknowns(self.robot, self.joints, entries)
