"""Result of an identification: values with intervals, a report, an actuators file, and draws from
its region.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress
from typing import Any, NamedTuple

import numpy as np

import batchpid as bp
from batchpid.arrays.array_types import Document, Float64
from batchpid.checks import integer
from batchpid.errors import InvalidArgumentError
from batchpid.io import documents
from batchpid.sim.identification.fit import INTERVAL, Fit
from batchpid.sim.identification.unknowns import (
    UNKNOWN_KINDS,
    Problem,
    Unknown,
    Unknowns,
    least_value,
)
from batchpid.sim.robot.robot import Robot
from batchpid.sim.robot.robot_options import load_robot_actuators

WHOLE_ROBOT = "robot"
"""Place of unknowns of the whole robot."""
KEY = "confidence_region"
"""Key of an actuators file, under "about"."""
AT_BOUND = 1e-6
"""Distance from a bound, over the typical size, at which a value is there."""
EXPLAINS, EXPLAINS_MOTION = 0.5, 0.25
"""Shares that a file may leave: of the position error of the robot as described, and of that of a
robot that does not move.
"""


class Estimate(NamedTuple):
    """Value of an unknown; friction and damping include the description's."""

    value: float
    low: float
    high: float
    """Ends of the 95 % interval."""
    is_shown: bool
    """False if the logs do not determine it: it has its likeliest value."""
    remark: str
    """Unknowns that it cannot be told from if it is not shown, or that it is at its bound."""

    def cell(self, is_positive: bool) -> str:
        """Return the value with its interval, or its upper end where the interval is wider."""
        half = self.high - self.value
        if not self.is_shown:
            text = "not shown by these logs"
        elif half > abs(self.value) and is_positive:
            text = f"< {self.high:.2g}"
        else:
            # As many digits as the first one of the interval has, and one more.
            digits = np.log10(max(abs(self.value), half) / half)
            text = f"{self.value:.{1 + int(np.ceil(digits))}g} ± {half:.1g}"
        return f"{text} ({self.remark})" if self.remark else text


@dataclass(frozen=True, eq=False)
class Identification:
    """Motors that explain the logs, with their uncertainty."""

    fit: Fit
    still: tuple[str, ...]
    """Joints that did not move."""

    @property
    def unknowns(self) -> Unknowns:
        """Unknowns of the fit; those that the logs do not show have their likeliest values."""
        return self.fit.problem.unknowns

    @property
    def values(self) -> Float64:
        """Values of the unknowns (unknowns,), in addition to the robot's description."""
        return self.unknowns.values(self.fit.point)

    @property
    def joint_names(self) -> list[str]:
        """Names of the joints that the logs hold and that moved."""
        return [self.unknowns.robot.joint_names[joint] for joint in self.unknowns.joints]

    @property
    def _described(self) -> Problem:
        """The problem without unknowns."""
        return replace(self.fit.problem, unknowns=replace(self.unknowns, entries=()))

    @cached_property
    def errors(self) -> tuple[Float64, Float64]:
        """Root mean square of the position error by joint (joints,) on the held-out part of the
        logs, simulated from the logged state: of the robot as described and as identified.
        """
        described = self._described.errors(np.zeros(0), free_states=False)
        identified = self.fit.problem.errors(self.fit.point, free_states=False)
        return described[0], identified[0]

    @property
    def held_out_error(self) -> tuple[float, float]:
        """Root mean square of :attr:`errors` over the joints [rad or m]."""
        before, after = (float(np.sqrt((errors**2).mean())) for errors in self.errors)
        return before, after

    @property
    def explains(self) -> bool:
        """True if less than half is left of the error of the robot as described, and a quarter of
        that of a robot that does not move.
        """
        before, after = self.held_out_error
        judged = self.fit.problem.judged
        moved = np.concatenate([(window.measured - window.qpos)[rows] for window, rows in judged])
        motion = float(np.sqrt((moved**2).mean()))
        return after < min(EXPLAINS * before, EXPLAINS_MOTION * motion)

    @property
    def remarks(self) -> list[str]:
        """Sentences on the parts that were left out, effects that were added, the robot's
        compensation, and a fit that stopped at the largest number of evaluations.
        """
        data = self.fit.problem.data
        drive = data[0].drive
        remarks = list(dict.fromkeys(remark for part in data for remark in part.log.remarks))
        for name in self.still:
            words = "did not move, or did not follow its setpoint: left out, and held in place"
            remarks.append(f"joint {name!r} {words}")
        for name, share in self.fit.effects.items():
            remarks.append(f"with {name}, which lowers the held-out error by {1 - share:.0%}")
        if drive.gravity:
            parts = {"coriolis": drive.coriolis, "friction": drive.modelled is not None}
            forces = "+".join(["gravity", *compress(parts, parts.values())])
            path = "apart from its motors" if drive.further else "through its motors"
            remarks.append(f"the robot compensates {forces} {path}")
        if half := self.fit.problem.half_row:
            words = "commands are interpolated between rows: if the robot held them (--hold), the"
            remarks.append(f"{words} delay is {half:.2g} s shorter")
        if self.fit.dropped:
            remarks.append(f"not needed by these logs: {', '.join(self.fit.dropped)}")
        if not self.explains:
            words = "check signs, units and order of the columns"
            remarks.append(f"the motion is not explained: {words}")
        if not self.fit.converged:
            remarks.append("the fit has not converged: the values are the best so far")
        return remarks

    @cached_property
    def estimates(self) -> dict[str, dict[str, Estimate]]:
        """Unknowns by joint, link of a mass, or "robot", and by kind, a name of
        :data:`batchpid.sim.identification.unknowns.UNKNOWN_KINDS`.
        """
        unknowns = self.unknowns
        halves = INTERVAL * self.fit.deviation
        least = [entry.least for entry in unknowns.entries]
        lows = np.maximum(self.values - halves, least)
        rows = np.array([self.values, lows, self.values + halves]) + unknowns.described
        low, high = unknowns.bounds
        is_held = (self.fit.point <= low + AT_BOUND) | (self.fit.point >= high - AT_BOUND)
        names = [f"{self._place(entry)}: {entry.kind}" for entry in unknowns.entries]
        estimates: dict[str, dict[str, Estimate]] = {}
        for at, entry in enumerate(unknowns.entries):
            is_shown = bool(self.fit.shown[at])
            others = [names[other] for other in np.flatnonzero(self.fit.alike[at]) if other != at]
            remark = "at its bound" if is_held[at] else ""
            if others and not is_shown:
                remark = f"cannot be told from {', '.join(others)}"
            row = Estimate(*rows[:, at].tolist(), is_shown, remark)  # type: ignore[call-arg]
            estimates.setdefault(self._place(entry), {})[entry.kind] = row
        return estimates

    def _place(self, entry: Unknown) -> str:
        """Return the joint of an unknown, the link of a mass, or "robot"."""
        return (
            self.joint_names[entry.place]
            if isinstance(entry.place, int)
            else entry.place or WHOLE_ROBOT
        )

    def interval(
        self, kind: str, joint: int | str | None = None
    ) -> tuple[float, float, float] | None:
        """Return estimate, lower and upper end of the 95 % interval; None if the logs do not
        identify it.

        Friction and damping include the description's. ``joint`` is the number of a joint among
        :attr:`joint_names`, its name, or the name of a link for "mass"; None for "delay",
        "setpoint_delay", "setpoint_lag" and "payload".

        Raises
        ------
        InvalidArgumentError
            There is no such unknown.
        """
        if kind in self.fit.dropped and joint is None:
            return None
        try:
            place = self.joint_names[joint] if isinstance(joint, int) else joint or WHOLE_ROBOT
            estimate = self.estimates[place][kind]
        except (IndexError, KeyError):
            problem = f"is no unknown of {joint!r}"
            remedy = f"there are {sorted({entry.kind for entry in self.unknowns.entries})}"
            raise InvalidArgumentError("kind", problem, value=kind, remedy=remedy) from None
        return estimate[:3] if estimate.is_shown else None

    def actuators(self) -> bp.Actuators:
        """Return the identified actuators; joints that are not in the logs are ideal.

        Friction and damping are in addition to the robot's description.
        """
        robot = self.unknowns.robot
        fields = _of_all_joints(self.unknowns, self.values[None])
        options: dict[str, Any] = {name: table[0] for name, table in fields.items()}
        return bp.make_actuators(robot.dof, **options, joint_names=robot.joint_names)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write :meth:`actuators` to a .yaml file, with estimates, errors and the
        confidence region.
        """
        region = {
            "unknowns": [[entry.kind, self._place(entry)] for entry in self.unknowns.entries],
            "estimate": self.values.tolist(),
            "root": self.fit.root.tolist(),
        }
        about = self.document() | {KEY: region}
        bp.save_actuators(path, self.actuators(), self.unknowns.robot.joint_names, about)

    def document(self) -> Document:
        """Return the result as plain values: :attr:`estimates`, errors and remarks."""
        estimates: Document = {}
        for place, table in self.estimates.items():
            estimates[place] = {kind: estimate._asdict() for kind, estimate in table.items()}
        return {
            "estimates": estimates,
            "held_out_error": list(self.held_out_error),
            "remarks": self.remarks,
            "identified_from": [part.log.source for part in self.fit.problem.data],
        }

    def report(self) -> str:
        """Return estimates, errors and remarks as text."""
        lines = ["values with 95 % intervals, SI units"]
        for place, table in self.estimates.items():
            cells = []
            for kind, estimate in table.items():
                cells.append(f"{kind} {estimate.cell(UNKNOWN_KINDS[kind].is_positive)}")
            lines.append(f"{place}: {', '.join(cells)}")
        before, after = self.held_out_error
        lines.append(
            "position error on the held-out part, simulated from the logged state:"
            f" {before:.3g} as described, {after:.3g} with these"
        )
        joints = zip(self.joint_names, self.errors[1], strict=True)
        lines.append(f"by joint: {', '.join(f'{name} {error:.2g}' for name, error in joints)}")
        return "\n".join([*lines, *self.remarks])


def _of_all_joints(unknowns: Unknowns, values: Float64) -> dict[str, Float64]:
    """Return the fields of actuators (n, dof) with ``values`` (n, unknowns)."""
    fields = dict[str, Float64]()
    neutral = {kind.field or name: kind.neutral for name, kind in UNKNOWN_KINDS.items()}
    for name, table in unknowns.tables(values, "motor").items():
        fields[name] = np.full((len(values), unknowns.robot.dof), neutral[name])
        fields[name][:, unknowns.joints] = table
        # A delay is that of the whole robot.
        if name == "command_delay":
            fields[name][:] = table[:, :1]
    return fields


def draw_motors(
    path: str | os.PathLike[str],
    robot: Robot,
    count: int,
    seed: int = 0,
) -> bp.Actuators:
    """Return ``count`` sets of motors of ``robot``, drawn from the confidence region in an
    actuators file.

    With the estimate m and the root L of the covariance L L^T, a draw is m + L z with normal z,
    within the bounds of the unknowns. Effects outside of the region keep their values in
    the file. Friction and damping are in addition to the robot's description. They are for a Runner
    with as many envs.

    Raises
    ------
    InvalidArgumentError
        The file has no region, or one of other joints.
    FileNotFoundError
        There is no such file.
    """
    count = integer("count", count, 1, 100_000)
    nominal = load_robot_actuators(str(path), robot)
    try:
        region = documents.read(path)["about"][KEY]
        entries = []
        for kind, place in region["unknowns"]:
            joint = robot.joint_names.index(place) if UNKNOWN_KINDS[kind].per == "joint" else None
            least = least_value(robot, kind, joint or 0)
            entries.append(Unknown(kind, joint, 0.0, 1.0, least))
        root = np.array(region["root"], float)
        normal = np.random.default_rng(seed).normal(size=(count, root.shape[1]))
        values = region["estimate"] + normal @ root.T
    except (KeyError, IndexError, TypeError, ValueError) as bad:
        problem = f"is missing or cannot be read ({bad})"
        remedy = "write the file with `batchpid identify` of this robot"
        raise InvalidArgumentError(f"{path}: {KEY}", problem, remedy=remedy) from None
    unknowns = Unknowns(robot, tuple(range(robot.dof)), {}, (), entries=tuple(entries))
    values = np.clip(values, *unknowns.bounds)
    return nominal.replace(**_of_all_joints(unknowns, values))
