"""Unknowns of a fit, with a start, a typical size, bounds and a prior, and their problem: simulated
against measured positions of all windows of logs.

A point has the values over their typical sizes. Bounds hold for the sum with the robot's
description: an addition to its friction or damping may be negative.

The effect of a window's free initial state is projected out of residuals and derivatives (H. G.
Bock, "Recent advances in parameter identification techniques for ODE", 1983). All candidates of an
evaluation - the present point, changes of it, and a change of each initial state - are simulated in
one batch.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain, compress
from typing import Any, Literal, NamedTuple

import numpy as np

from batchpid.arrays.array_types import Bool, Float64
from batchpid.motors.actuators import Actuators
from batchpid.sim.identification.simulator import Candidates, LogData, Stretch, simulate
from batchpid.sim.robot.robot import Robot

FEWER, LEAST_WINDOWS = 4, 12
"""Stride of the windows in the first steps of a fit, and the least number that it must leave."""
ENVS = 1024
"""Most simulations at once."""
STATE_STEPS = 1e-3, 1e-2
"""Changes of initial positions and velocities."""
RESIDUAL_BOUND = 3.0
"""Bound of the residuals [rad or m], reached where a simulation diverges."""
RESOLUTION = 1e-5
"""Least size of residuals [rad or m]: encoders show no less."""


class Kind(NamedTuple):
    """Kind of unknown, in SI units."""

    target: Literal["motor", "robot", "sensor", "setpoint"]
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
    "slew": Kind("setpoint", "joint", "top_speed", 2.0, np.inf),
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
in addition to "friction", "stribeck" the speed at which half of it is left. "slew" is the limit of
the setpoints' rate, "mass" a factor of a link's mass and inertia. The delay and the first-order lag
of setpoints belong to their sender.
"""
BASIC = ("armature", "damping", "friction", "strength", "bias", "delay")
"""Kinds that every fit has."""
EXTRAS = ("load_friction", "stribeck", "offset", "mass", "slew")
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
        return Candidates(Actuators(**fields), sender.get("slew"), late, lag, **masses)

    def only(self, mask: Bool) -> Unknowns:
        """Return the unknowns of a mask (unknowns,); the others have their neutral value."""
        return replace(self, entries=tuple(compress(self.entries, mask)))


@dataclass(frozen=True, eq=False)
class Problem:
    """Windows of logs, the simulation of each log, and the unknowns."""

    data: Sequence[LogData]
    windows: Sequence[Stretch]
    unknowns: Unknowns
    run: Callable[..., Any] = map
    """Map over groups of windows: ``map``, or that of worker processes."""

    @property
    def half_row(self) -> float:
        """Time by which commanded efforts seem late if the robot held them and the log is interpolated
        [s]: half of the time between rows. A delay of setpoints is an unknown of its own.
        """
        log, _, _, drive = self.data[0]
        if log.held or log.measured or drive.mode == "pid":
            return 0.0
        return max(float(np.median(np.diff(log.command_time))) - drive.timestep, 0.0) / 2

    def coarse(self) -> Problem:
        """Return the problem with every FEWER-th window, for the first steps of a fit; itself where
        windows are few.
        """
        windows = self.windows[::FEWER]
        return replace(self, windows=windows) if len(windows) >= LEAST_WINDOWS else self

    def evaluate(
        self,
        windows: Sequence[Stretch],
        point: Float64,
        changes: Float64 | None = None,
        free_states: bool = True,
    ) -> list[Float64]:
        """Return the residuals of each window at a point (unknowns,), and their changes by
        ``changes`` (n, unknowns) of the point: (rows, joints, 1 + n).

        Initial states of windows of efforts are projected out if they are free.
        """
        joints = windows[0].measured.shape[1]
        free = free_states and self.data[0].drive.mode == "effort"
        shifts = np.diag(np.repeat(STATE_STEPS, joints * free))
        # Rows: the point, each change of it, a change of each initial state.
        moved = point[None] if changes is None else np.vstack([point, point + changes])
        count = len(moved)
        points = np.vstack([moved, np.tile(point, (len(shifts), 1))])
        states = np.zeros((len(points), 2, joints))
        states[count:] = shifts.reshape(-1, 2, joints)
        # Windows of one log are simulated at once, as many as are fast together.
        many = max(1, ENVS // len(points))
        groups = defaultdict[Any, list[Stretch]](list)
        for number, window in enumerate(windows):
            groups[window.log, number // many].append(window)
        tasks = [self._task(group, points, states) for group in groups.values()]
        tables = []
        results = chain(*self.run(simulate, *zip(*tasks, strict=True)))
        for window, table in zip(windows, results, strict=True):
            errors = np.clip(window.measured - table, -RESIDUAL_BOUND, RESIDUAL_BOUND)
            errors[1:] -= errors[0]
            tables.append(_projected(np.moveaxis(errors, 0, 2), count))
        return tables

    def _task(self, windows: list[Stretch], points: Float64, states: Float64) -> Any:
        """Return the arguments of :func:`simulate` for windows of a log, each at all points."""
        _, _, plant, drive = self.data[windows[0].log]
        points, states = (np.repeat(table, len(windows), axis=0) for table in (points, states))
        robots = self.unknowns.candidates(self.unknowns.values(points))
        return plant, drive, robots, states, windows

    @property
    def judged(self) -> list[tuple[Stretch, Bool]]:
        """Windows with held-out rows, and the masks of these; all rows if none is held out."""
        held_out = [(window, ~window.fitted) for window in self.windows if not window.fitted.all()]
        return held_out or [(window, window.fitted) for window in self.windows]

    def fitted(self, point: Float64, changes: Float64 | None = None) -> Float64:
        """Return residuals of the fitted rows, and their derivatives by the unknowns along
        ``changes`` (n, unknowns) of the point: (rows, joints, 1 + unknowns).
        """
        windows = [window for window in self.windows if window.fitted.any()]
        pairs = zip(windows, self.evaluate(windows, point, changes), strict=True)
        table = np.concatenate([table[window.fitted] for window, table in pairs])
        if changes is None:
            return table
        slopes = table[..., 1:] @ np.linalg.pinv(changes, rcond=1e-12).T
        return np.concatenate([table[..., :1], slopes], axis=2)

    def errors(
        self,
        point: Float64,
        changes: Float64 | None = None,
        free_states: bool = True,
    ) -> Float64:
        """Return the root mean squares (1 + n, joints) of the position error at the held-out rows,
        at a point and at ``changes`` (n, unknowns) of it; at all rows if none is held out.

        Windows of efforts begin at the logged state, or at the best one if states are free.
        """
        windows, rows = zip(*self.judged, strict=True)
        tables = self.evaluate(windows, point, changes, free_states)
        table = np.concatenate([table[mask] for table, mask in zip(tables, rows, strict=True)])
        table[..., 1:] += table[..., :1]
        size: Float64 = np.sqrt((table**2).mean(0)).T
        return size


def size_of(table: Float64) -> Float64:
    """Return the size of residuals (rows, joints, 1 + n) by joint: the root mean square, the largest
    tenth cut.
    """
    errors = np.abs(table[..., 0])
    errors = np.minimum(errors, np.quantile(errors, 0.9, axis=0))
    size: Float64 = np.sqrt((errors**2).mean(0)) + RESOLUTION
    return size


def _projected(table: Float64, count: int) -> Float64:
    """Return the first ``count`` columns of a table (rows, joints, columns), less their projection
    on the others.
    """
    columns = table.reshape(-1, table.shape[2])
    basis = columns[:, count:]
    rest = columns[:, :count]
    if basis.shape[1]:
        q, _ = np.linalg.qr(basis / (np.linalg.norm(basis, axis=0) + 1e-12))
        rest = rest - q @ (q.T @ rest)
    return rest.reshape(*table.shape[:2], count)
