"""Result of an identification: values with intervals, a report, an actuators file, and draws from
its region.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import batchpid as bp
from batchpid.arrays.array_types import Document, Float64
from batchpid.checks import integer
from batchpid.errors import InvalidArgumentError
from batchpid.io import documents
from batchpid.sim.identification.fit import INTERVAL, Fit
from batchpid.sim.identification.problem import Problem
from batchpid.sim.identification.simulator import changed_params
from batchpid.sim.identification.unknowns import UNKNOWN_KINDS, Unknown, Unknowns, least_value
from batchpid.sim.robot.robot import Robot
from batchpid.sim.robot.robot_options import load_robot_actuators
from batchpid.sim.robot.urdf_export import to_urdf
from batchpid.stages import Control

if TYPE_CHECKING:
    from matplotlib.figure import Figure

KEY = "confidence_region"
"""Key of an actuators file, under "about"."""
AT_BOUND = 1e-6
"""Distance from a bound, over the typical size, at which a value is there."""
EXPLAINS = 0.5
"""Share of the position error of the robot as described that a file may leave."""


@dataclass(frozen=True, eq=False)
class Identification:
    """Motors that explain the logs, with their uncertainty."""

    fit: Fit
    still: tuple[str, ...]
    """Joints that did not move."""

    @cached_property
    def errors(self) -> tuple[Float64, Float64]:
        """Root mean square of the position error by joint (joints,) on the held-out part of the
        logs, simulated from the logged state: of the robot as described and as identified.
        """
        problem = self.fit.problem
        described = self._described.errors(np.zeros(0), free_states=False)
        return described[0], problem.errors(self._point, free_states=False)[0]

    @property
    def _described(self) -> Problem:
        """The problem without unknowns."""
        return replace(self.fit.problem, unknowns=replace(self.unknowns, entries=()))

    @property
    def unknowns(self) -> Unknowns:
        """Unknowns of the fit; those that the logs do not show have their likeliest values."""
        return self.fit.problem.unknowns

    @property
    def remarks(self) -> list[str]:
        """Sentences on what was left out of the logs, and on joints that did not move."""
        logs = (part.log for part in self.fit.problem.data)
        remarks = dict.fromkeys(remark for log in logs for remark in log.remarks)
        words = "did not move, or did not follow its setpoint: left out, and held in place"
        return [*remarks, *(f"joint {name!r} {words}" for name in self.still)]

    @property
    def _point(self) -> Float64:
        return self.fit.point

    @property
    def robot(self) -> Robot:
        """The robot, at rest where it did not move."""
        return self.unknowns.robot

    @property
    def joints(self) -> tuple[int, ...]:
        """Numbers of the joints that the logs hold and that moved."""
        return self.unknowns.joints

    @property
    def drive(self) -> Control:
        """Control of the first log."""
        return self.fit.problem.data[0].drive

    @property
    def values(self) -> Float64:
        """Values of the unknowns (unknowns,), in addition to the robot's description."""
        return self.unknowns.values(self._point)

    @property
    def held_out_error(self) -> tuple[float, float]:
        """Root mean square of :attr:`errors` over the joints [rad or m]."""
        before, after = (float(np.sqrt((errors**2).mean())) for errors in self.errors)
        return before, after

    @property
    def explains(self) -> bool:
        """True if less than half of the error of the robot as described is left."""
        before, after = self.held_out_error
        return after < EXPLAINS * before

    @property
    def converged(self) -> bool:
        """False if the fit has stopped at the largest number of evaluations."""
        return self.fit.converged

    @property
    def effects(self) -> dict[str, float]:
        """Effects that were added because they lower the held-out error, and the share of it that
        each left.
        """
        return dict(self.fit.effects)

    @property
    def not_shown(self) -> dict[str, list[str]]:
        """Unknowns that the logs do not show, e.g. "elbow: strength", and for each those that it
        cannot be told from.
        """
        shown, alike = self.fit.certainty.shown, self.fit.certainty.alike
        names = [self._name(entry) for entry in self.unknowns.entries]
        groups = dict[str, list[str]]()
        for row in np.flatnonzero(~shown).tolist():
            others = np.flatnonzero(alike[row]).tolist()
            groups[names[row]] = [names[other] for other in others if other != row]
        return groups

    @property
    def not_needed(self) -> list[str]:
        """Kinds of unknowns of the setpoints that were left out: without them the held-out error is
        about the same.
        """
        return [entry.kind for entry in self.fit.dropped]

    @property
    def at_bounds(self) -> list[str]:
        """Unknowns whose value, with the description's, is at its bound."""
        low, high = self.unknowns.bounds
        is_held = (self._point <= low + AT_BOUND) | (self._point >= high - AT_BOUND)
        return [self._name(entry) for entry in self.unknowns.only(is_held).entries]

    def interval(
        self, kind: str, joint: int | str | None = None
    ) -> tuple[float, float, float] | None:
        """Return estimate, lower and upper end of the 95 % interval; None if the logs do not
        identify it.

        Friction and damping include the description's. ``kind`` is a name of
        :data:`batchpid.sim.identification.unknowns.UNKNOWN_KINDS`, ``joint`` the number of a joint
        among :attr:`joints`, the name of a link for "mass", None for "delay", "setpoint_delay" and
        "payload".

        Raises
        ------
        InvalidArgumentError
            There is no such unknown.
        """
        places = [(entry.kind, entry.place) for entry in self.unknowns.entries]
        dropped = [(entry.kind, entry.place) for entry in self.fit.dropped]
        if (kind, joint) not in places + dropped:
            problem = f"is no unknown of {joint!r}"
            remedy = f"there are {sorted({name for name, _ in places + dropped})}"
            raise InvalidArgumentError("kind", problem, value=kind, remedy=remedy)
        if (kind, joint) in dropped:
            return None
        row = places.index((kind, joint))
        return self._rows[row] if self.fit.certainty.shown[row] else None

    @property
    def _rows(self) -> list[tuple[float, float, float]]:
        """Estimate and ends of the interval of each unknown, with the description's values."""
        described = self.unknowns.described
        halves = INTERVAL * self.fit.certainty.deviation
        least = [entry.least for entry in self.unknowns.entries]
        lows = np.maximum(self.values - halves, least)
        rows = np.array([self.values, lows, self.values + halves]) + described
        return [tuple(row) for row in rows.T.tolist()]

    def _place(self, entry: Unknown) -> str | None:
        """Return the joint of an unknown, or the link of a mass."""
        if entry.joint is None:
            return entry.link if entry.kind == "mass" else None
        return self.robot.joint_names[self.joints[entry.joint]]

    def _name(self, entry: Unknown) -> str:
        return f"{self._place(entry) or 'robot'}: {entry.kind}"

    def actuators(self) -> bp.Actuators:
        """Return the identified actuators; joints that are not in the logs are ideal.

        Friction and damping are in addition to the robot's description.
        """
        fields = _of_all_joints(self.unknowns, self.values[None])
        options: dict[str, Any] = {name: table[0] for name, table in fields.items()}
        return bp.make_actuators(self.robot.dof, **options, joint_names=self.robot.joint_names)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write :meth:`actuators` to a .yaml or .json file, with intervals, errors and the
        confidence region; and :meth:`gains`, if the law was identified, to NAME-gains.yaml.
        """
        region = {
            "unknowns": [[entry.kind, self._place(entry)] for entry in self.unknowns.entries],
            "estimate": self.values.tolist(),
            "root": self.fit.certainty.root.tolist(),
        }
        about = self.document() | {KEY: region}
        bp.save_actuators(path, self.actuators(), self.robot.joint_names, about)
        gains = self.gains()
        if gains is not None:
            names = [self.robot.joint_names[joint] for joint in self.joints]
            bp.save_params(Path(path).with_name(f"{Path(path).stem}-gains.yaml"), gains, names)

    def document(self) -> Document:
        """Return the result as plain values: estimate and 95 % interval of each unknown by joint,
        link or "robot", and the errors.
        """
        intervals: Document = {}
        shown = self.fit.certainty.shown.tolist()
        for entry, row, is_shown in zip(self.unknowns.entries, self._rows, shown, strict=True):
            if is_shown:
                intervals.setdefault(self._place(entry) or "robot", {})[entry.kind] = list(row)
        return {
            "intervals": intervals,
            "not_shown": self.not_shown,
            "not_needed": self.not_needed,
            "at_bounds": self.at_bounds,
            "effects": self.effects,
            "did_not_move_hence_ideal": list(self.still),
            "remarks": self.remarks,
            "held_out_error": list(self.held_out_error),
            "converged": self.converged,
            "compensation_through_motors": not self.drive.further,
            "identified_from": [part.log.source for part in self.fit.problem.data],
        }

    def corrected_urdf(self) -> str:
        """Return the URDF of the robot with the identified masses; the links of a body keep their
        shares of its mass.

        Raises
        ------
        InvalidArgumentError
            Masses are not among the unknowns (extras=["mass"]).
        """
        pairs = zip(self.unknowns.entries, self.values.tolist(), strict=True)
        factors = {str(entry.link): value for entry, value in pairs if entry.kind == "mass"}
        if not factors:
            remedy = "identify with extras=['mass']"
            raise InvalidArgumentError("corrected_urdf", "no mass was found", remedy=remedy)
        return to_urdf(self.robot, mass_factors=factors).text

    def gains(self) -> bp.PIDParams | None:
        """Return the params of the identified law, of the logged joints; None without unknowns of
        the law.
        """
        law = self.unknowns.tables(self.values[None], "law")
        if self.drive.mode == "effort" or law.keys() <= {"slew"}:
            return None
        return changed_params(self.drive.params, law)

    def figure(self) -> Figure:
        """Return a picture of the position errors along the first log, before and after."""
        from batchpid.sim import plots

        windows = [window for window in self.fit.problem.windows if window.log == 0]
        tables = []
        for problem in (self._described, self.fit.problem):
            point = self._point[: len(problem.unknowns.entries)]
            first = replace(problem, windows=windows)
            tables.append(first.evaluate(point, free_states=False, held_out=True))
        errors = []
        for window, before, after in zip(windows, *tables, strict=True):
            errors.append((window.time, window.fitted, before[..., 0], after[..., 0]))
        names = [self.robot.joint_names[joint] for joint in self.joints]
        units = [self.robot.units[joint] for joint in self.joints]
        title = f"{self.robot.name}: position error, shaded where it was not fitted"
        return plots.fit_errors(errors, names, units, title)

    def report(self) -> str:
        """Return values, intervals and errors as text."""
        document = self.document()
        lines = ["values with 95 % intervals, SI units"]
        for place, table in document["intervals"].items():
            cells = ", ".join(f"{kind} {_cell(kind, *row)}" for kind, row in table.items())
            lines.append(f"{place}: {cells}")
        drive = self.drive
        if drive.gravity:
            parts = {"coriolis": drive.coriolis, "friction": drive.modelled is not None}
            forces = "+".join(["gravity", *compress(parts, parts.values())])
            path = "apart from its motors" if drive.further else "through its motors"
            lines.append(f"the robot compensates {forces} {path}")
        before, after = self.held_out_error
        lines.append(
            "position error on the held-out part, simulated from the logged state:"
            f" {before:.3g} as described, {after:.3g} with these"
        )
        joints = zip(self.joints, self.errors[1], strict=True)
        errors = [f"{self.robot.joint_names[joint]} {error:.2g}" for joint, error in joints]
        lines.append(f"by joint: {', '.join(errors)}")
        for name, share in self.effects.items():
            lines.append(f"with {name}, which lowers the held-out error by {1 - share:.0%}")
        for name, others in self.not_shown.items():
            words = f", which cannot be told from {', '.join(others)}" if others else ""
            lines.append(f"not shown by these logs: {name}{words}")
        if self.not_needed:
            lines.append(f"not needed by these logs: {', '.join(self.not_needed)}")
        if self.at_bounds:
            lines.append(f"at its bound: {', '.join(self.at_bounds)}")
        if not self.converged:
            lines.append("the fit has not converged: the values are the best so far")
        lines += self.remarks
        return "\n".join(lines)


def _cell(
    kind: str,
    value: float,
    low: float,
    high: float,
) -> str:
    """Return a value with its interval, or its bound where the interval is wider than itself."""
    half = high - value
    if half > abs(value) and UNKNOWN_KINDS[kind].positive:
        return f"< {high:.2g}"
    # As many digits as the first one of the interval has, and one more.
    digits = np.log10(max(abs(value), half) / half)
    return f"{value:.{1 + int(np.ceil(digits))}g} ± {half:.1g}"


def _of_all_joints(unknowns: Unknowns, values: Float64) -> dict[str, Float64]:
    """Return the fields of actuators (n, dof) with ``values`` (n, unknowns)."""
    fields = dict[str, Float64]()
    neutral = {kind.field: kind.neutral for kind in UNKNOWN_KINDS.values()}
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
    the file. Friction and damping are in addition to the robot's description. For
    ``tune(robot, motors=...)`` or a Runner with as many envs.

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
            least = max(least_value(robot, kind, joint or 0), 1e-3 * UNKNOWN_KINDS[kind].neutral)
            entries.append(Unknown(kind, joint, 0.0, 1.0, least))
        root = np.array(region["root"], float)
        normal = np.random.default_rng(seed).normal(size=(count, root.shape[1]))
        values = region["estimate"] + normal @ root.T
    except (KeyError, IndexError, TypeError, ValueError) as bad:
        problem = f"is missing or cannot be read ({bad})"
        remedy = "write the file with `batchpid identify` of this robot"
        raise InvalidArgumentError(f"{path}: {KEY}", problem, remedy=remedy) from None
    unknowns = Unknowns(robot, tuple(range(robot.dof)), {}, (), tuple(entries))
    values = np.clip(values, *unknowns.bounds)
    return nominal.replace(**_of_all_joints(unknowns, values))
