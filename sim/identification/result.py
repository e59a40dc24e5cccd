"""Result of an identification: values with intervals, a report, an actuators file, and draws from
its region.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

import batchpid as bp
from batchpid.arrays.array_types import Document, Float64
from batchpid.checks.validate import integer
from batchpid.errors import InvalidArgumentError
from batchpid.io import documents
from batchpid.sim.identification.fit import STEP, Problem, Solution, Window
from batchpid.sim.identification.intervals import INTERVAL, Intervals
from batchpid.sim.identification.log import Log
from batchpid.sim.identification.simulator import LogControl
from batchpid.sim.identification.unknowns import DESCRIBED, KINDS, Unknown, Unknowns
from batchpid.sim.robot.actuator_checks import load_robot_actuators
from batchpid.sim.robot.robot import Robot
from batchpid.sim.robot.urdf_export import to_urdf

if TYPE_CHECKING:
    from matplotlib.figure import Figure

KEY = "confidence_region"
"""Key of an actuators file, under "about"."""
LEAST_GAIN = 0.1
"""Least share of the remaining squared error that a further unknown has to explain to be named."""
ALIKE = 0.6
"""Share of the best explanation from which another one is as good."""
EXPLAINS = 0.5
"""Share of the position error with ideal motors that a file may leave."""


@dataclass(frozen=True, eq=False)
class Identification:
    """Motors that explain the logs, with their uncertainty."""

    robot: Robot
    joints: tuple[int, ...]
    """Numbers of the joints that the logs hold and that moved."""
    unknowns: Unknowns
    """Unknowns that the logs show."""
    hidden: Unknowns
    """Unknowns that the logs do not identify; they have the values of ideal motors."""
    values: Float64
    """Values of the unknowns (unknowns,)."""
    intervals: Intervals
    held_out_error: tuple[float, float]
    """Root mean square of the position error [rad or m] on the held-out part of the logs, simulated
    from the logged state, of the robot as described and as identified.
    """
    errors: tuple[Float64, Float64, Float64]
    """The same by joint (joints,), and with the initial state of each window fitted, as in the
    fit.
    """
    converged: bool
    """False if the fit has stopped at the largest number of evaluations."""
    advice: str
    """Sentence on an effect that would lower the error most, or "none"."""
    logs: tuple[str, ...]
    """Names of the logs."""
    still: tuple[str, ...]
    """Joints that did not move."""
    drive: LogControl
    problem: Problem
    point: Float64

    @classmethod
    def of(
        cls,
        logs: Sequence[Log],
        still: Sequence[str],
        problem: Problem,
        solution: Solution,
        intervals: Intervals,
        hidden: Unknowns,
        fitted: Problem,
    ) -> Identification:
        """Return the result of a ``solution`` of the ``fitted`` windows of a ``problem``."""
        unknowns = problem.unknowns
        judged = any(not window.fitted.all() for window in problem.windows)

        def mask(window: Window) -> Any:
            return ~window.fitted if judged else window.fitted

        ideal = replace(problem, unknowns=replace(unknowns, entries=()))
        before = ideal.error(np.zeros(0), mask, free_states=False)
        after = problem.error(solution.point, mask, free_states=False)
        free = problem.error(solution.point, mask)
        total = tuple(float(np.sqrt((errors**2).mean())) for errors in (before, after))
        return cls(
            unknowns.robot,
            unknowns.joints,
            unknowns,
            hidden,
            unknowns.values(solution.point[None])[0],
            intervals,
            (total[0], total[1]),
            (before, after, free),
            solution.converged,
            advice(fitted, solution),
            tuple(log.source for log in logs),
            tuple(still),
            problem.drives[0],
            problem,
            solution.point,
        )

    def interval(
        self, kind: str, joint: int | str | None = None
    ) -> tuple[float, float, float] | None:
        """Return estimate, lower and upper end of the 95 % interval; None if the logs do not
        identify it.

        ``kind`` is a name of :data:`batchpid.sim.identification.unknowns.KINDS`, ``joint`` the
        number of a joint among :attr:`joints`, the name of a link for "mass", None for "delay",
        "setpoint_delay" and "payload".

        Raises
        ------
        InvalidArgumentError
            There is no such unknown.
        """
        entries = self.unknowns.entries + self.hidden.entries
        for at, entry in enumerate(entries):
            if (entry.kind, entry.joint if entry.link is None else entry.link) == (kind, joint):
                return self._row(at) if at < len(self.values) else None
        kinds = ", ".join(sorted({entry.kind for entry in entries}))
        raise InvalidArgumentError(
            "kind", f"is no unknown of {joint!r}", value=kind, remedy=f"there are {kinds}"
        )

    def _row(self, at: int) -> tuple[float, float, float]:
        value, half = float(self.values[at]), INTERVAL * float(self.intervals.deviation[at])
        low = (
            self.unknowns.entries[at].floor
            if KINDS[self.unknowns.entries[at].kind].positive
            else -np.inf
        )
        return value, max(value - half, low), value + half

    @property
    def explains(self) -> bool:
        """True if less than half of the error with ideal motors is left."""
        return self.held_out_error[1] < EXPLAINS * self.held_out_error[0]

    @property
    def not_identified(self) -> list[str]:
        """Unknowns that the logs do not identify, e.g. "elbow: strength"."""
        return [self._name(entry) for entry in self.hidden.entries]

    def _name(self, entry: Unknown) -> str:
        return ": ".join(filter(None, (self._place(entry), entry.kind)))

    def actuators(self) -> bp.Actuators:
        """Return the identified actuators; joints that are not in the logs are ideal.

        Friction and damping are in addition to the robot's description.
        """
        columns = _columns(self.unknowns, self.values[None])
        options: dict[str, Any] = {name: column[0] for name, column in columns.items()}
        return bp.make_actuators(self.robot.dof, **options, joint_names=self.robot.joint_names)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write :meth:`actuators` to a .yaml or .json file, with intervals, errors and the
        confidence region.
        """
        document = self.document()
        names = [[entry.kind, self._place(entry)] for entry in self.unknowns.entries]
        rows = [
            [float(f"{value:.5f}") for value in row[: at + 1]]
            for at, row in enumerate(self.intervals.correlation)
        ]
        region = {
            "unknowns": names,
            "estimate": self.values.tolist(),
            "standard_deviation": self.intervals.deviation.tolist(),
            "correlation": rows,
        }
        about = {
            key: document[key]
            for key in ("identified_from", "held_out_error", "intervals", "not_shown")
        }
        about["did_not_move_hence_ideal"] = list(self.still)
        bp.save_actuators(path, self.actuators(), self.robot.joint_names, about | {KEY: region})

    def _place(self, entry: Unknown) -> str | None:
        return (
            entry.link if entry.joint is None else self.robot.joint_names[self.joints[entry.joint]]
        )

    def document(self) -> Document:
        """Return the result as plain values: estimate and 95 % interval of each unknown, and the
        errors.
        """
        intervals: Document = {}
        for at, entry in enumerate(self.unknowns.entries):
            place = self._place(entry)
            table = intervals if place is None else intervals.setdefault(place, {})
            table[entry.kind] = list(self._row(at))
        return {
            "intervals": intervals,
            "not_shown": self.not_identified,
            "held_out_error": list(self.held_out_error),
            "converged": self.converged,
            "compensation_through_motors": self.drive.compensate != "none" and self.drive.through,
            "identified_from": list(self.logs),
            "advice": self.advice,
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
        factors = {entry.link: value for entry, value in pairs if entry.link is not None}
        if not factors:
            raise InvalidArgumentError(
                "corrected_urdf", "no mass was found", remedy="identify with extras=['mass']"
            )
        return to_urdf(self.robot, mass_factors=factors).text

    def gains(self) -> bp.PIDParams | None:
        """Return the params of the identified law, of the logged joints; None without unknowns of
        the law.
        """
        law = self.unknowns.candidates(self.values[None]).law
        if self.drive.params is None or law.keys().isdisjoint(("gain", "kd", "saturation")):
            return None
        from batchpid.sim.identification.simulator import changed_params

        return changed_params(self.drive.params, law)

    def figure(self) -> Figure:
        """Return a picture of the position errors along the first log, before and after."""
        from batchpid.sim import plots

        windows = [window for window in self.problem.windows if window.log == 0]
        shown = replace(self.problem, windows=windows)
        ideal = replace(shown, unknowns=replace(self.unknowns, entries=()))
        before = ideal.evaluate(np.zeros(0), free_states=False).residuals
        after = shown.evaluate(self.point, free_states=False).residuals
        parts = zip(windows, before, after, strict=True)
        errors = [
            plots.FitErrors(window.time, window.fitted, first, second)
            for window, first, second in parts
        ]
        names, units = (
            [table[joint] for joint in self.joints]
            for table in (self.robot.joint_names, self.robot.units)
        )
        title = f"{self.robot.name}: position error, shaded where it was not fitted"
        return plots.fit_errors(errors, names, units, title)

    def report(self) -> str:
        """Return values, intervals and errors as text."""
        kinds = list(
            dict.fromkeys(entry.kind for entry in self.unknowns.entries if entry.joint is not None)
        )
        names = [self.robot.joint_names[joint] for joint in self.joints]
        cells = {
            (entry.kind, self._place(entry)): self._cell(at)
            for at, entry in enumerate(self.unknowns.entries)
        }
        rows = [["95 % intervals, SI units", *kinds]]
        rows += [
            [name, *(cells.get((kind, name), "not shown") for kind in kinds)] for name in names
        ]
        widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
        lines = [
            "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True))
            for row in rows
        ]
        lines += [""]
        shared = [entry for entry in self.unknowns.entries if entry.joint is None]
        lines += [f"{self._name(entry)}: {cells[entry.kind, entry.link]}" for entry in shared]
        if self.drive.compensate != "none":
            path = "through its motors" if self.drive.through else "apart from its motors"
            lines.append(f"the robot compensates {self.drive.compensate} {path}")
        before, after = self.held_out_error
        free = float(np.sqrt((self.errors[2] ** 2).mean()))
        lines.append(
            f"position error on the held-out part, simulated from the logged state: {before:.3g}"
            f" with ideal motors, {after:.3g} with these"
        )
        if self.drive.params is None:
            lines.append(f"with the initial state of each 0.3 s fitted: {free:.3g}")
        joints = [f"{name} {error:.2g}" for name, error in zip(names, self.errors[1], strict=True)]
        lines.append(f"by joint: {', '.join(joints)}")
        if self.hidden.entries:
            lines.append(
                f"not shown by these logs, hence as ideal: {', '.join(self.not_identified)}"
            )
        if not self.converged:
            lines.append("the fit has not converged: the values are the best so far")
        lines.append(self.advice)
        return "\n".join(lines)

    def _cell(self, at: int) -> str:
        value, low, high = self._row(at)
        half = max(high - value, value - low)
        if half > abs(value) and KINDS[self.unknowns.entries[at].kind].positive:
            return f"< {high:.2g}"
        digits = (
            int(np.clip(np.ceil(np.log10(abs(value) / half)) + 1, 1, 6)) if value and half else 3
        )
        return f"{value:.{digits}g} ± {half:.1g}"


def _columns(unknowns: Unknowns, values: Float64) -> dict[str, Float64]:
    """Return the fields of actuators (n, dof) with ``values`` (n, unknowns), without the
    description's part.
    """
    robot = unknowns.robot
    joints = list(unknowns.joints)
    columns = dict[str, Float64]()
    for name, table in unknowns.tables(values).items():
        kind = KINDS[name]
        if kind.target != "motor":
            continue
        if kind.positive:
            described = getattr(robot, DESCRIBED[name])[joints] if name in DESCRIBED else 0.0
            table = np.maximum(table - described, 1e-3 * kind.neutral)
        column = columns[kind.field] = np.full((len(values), robot.dof), kind.neutral)
        column[:, joints] = table
        if kind.per == "robot":
            column[:] = table[:, :1]
    if "static" in columns:
        columns["static"] += columns.get("coulomb", 0.0)
    return columns


def advice(problem: Problem, solution: Solution) -> str:
    """Return a sentence on the effect that would explain most of the remaining error of a fit, by
    its derivatives.

    Each further unknown is added alone to the unknowns of the fit.
    """
    unknowns = problem.unknowns
    plant = problem.plants[0]
    present = {entry.kind for entry in unknowns.entries}
    further = [
        Unknown("mass", None, 1.0, 1.0, link=link)
        for link in plant.heavy_links
        if "mass" not in present
    ]
    for kind in (
        "offset",
        "load_friction",
        *(("kd",) if problem.drives[0].params is not None else ()),
    ):
        if kind not in present:
            start = {"offset": 0.0, "load_friction": 1e-4, "kd": 1.0}[kind]
            size = float(KINDS[kind].size)
            further += [Unknown(kind, joint, start, size) for joint in range(len(unknowns.joints))]
    entries = (*unknowns.entries, *further)
    wide = replace(unknowns, entries=entries)
    point = np.concatenate([solution.point, [entry.coordinate(entry.start) for entry in further]])
    steps = np.full(len(point), STEP)
    steps[[at for at, entry in enumerate(entries) if entry.kind == "load_friction"]] = 4.0
    wider = replace(problem, unknowns=wide)
    residual, matrix = wider.system(wider.evaluate(point, steps), point, solution.size)
    count = len(unknowns.entries)
    weight = (1 + residual**2 / 4) ** -0.25
    weight[-len(further) :] = 0.1 * np.array(
        [entry.spread for entry in further]
    )  # each may change by a factor
    residual, matrix = weight * residual, weight[:, None] * matrix
    strengths = [at for at, entry in enumerate(unknowns.entries) if entry.kind == "strength"]
    gains = list[float]()
    changes = list[float]()
    distances = list[float]()
    for number in range(len(further)):
        columns = [*range(count), count + number]
        change, *_ = np.linalg.lstsq(matrix[:, columns], -residual, rcond=1e-10)
        left = residual + matrix[:, columns] @ change
        gains.append(1 - float(left @ left) / float(residual @ residual))
        changes.append(float(change[-1]))
        distances.append(
            float((((solution.point + change[:-1]) / unknowns.spread) ** 2)[strengths].sum())
        )
    if not further or max(gains) < LEAST_GAIN:
        return "no further effect that was tried would explain a tenth of the remaining error"
    # Explanations that are as good as equal differ in how far they bring the strengths from 1.
    alike = sorted(
        np.flatnonzero(np.array(gains) > ALIKE * max(gains)), key=lambda number: distances[number]
    )
    words = " or ".join(_effect(problem, further[number], changes[number]) for number in alike[:2])
    text = f"{words} would explain {100 * max(gains):.0f} % of the remaining squared error"
    kinds = {further[number].kind for number in alike[:2]}
    weigh = "; or the strengths are as found: weigh the link" if "mass" in kinds else ""
    return f"{text} (extras: {', '.join(sorted(kinds))}){weigh}"


def _effect(problem: Problem, entry: Unknown, change: float) -> str:
    """Return a change of an unknown in words."""
    if entry.link is not None:
        percent = 100 * float(np.expm1(np.clip(change, -1.5, 1.5)))
        return f"link {entry.link} {abs(percent):.0f} % {'heavier' if percent > 0 else 'lighter'}"
    names = problem.unknowns.robot.joint_names
    return f"{entry.kind} of {names[problem.unknowns.joints[entry.joint or 0]]}"


def draw_motors(
    path: str | os.PathLike[str], robot: Robot, count: int, seed: int = 0
) -> bp.Actuators:
    """Return ``count`` sets of motors of ``robot``, drawn from the confidence region in an
    actuators file.

    With the estimate m, standard deviations d and correlations R, a draw is m + d * (R^1/2 z) with
    normal z, within the bounds of the unknowns. Effects outside of the region keep their values in
    the file. Friction and damping are in addition to the robot's description. For
    ``robot.tuned(actuators=...)`` or a Runner with as many envs.

    Raises
    ------
    InvalidArgumentError
        The file has no region, or one of other joints.
    FileNotFoundError
        There is no such file.
    """
    nominal, document = load_robot_actuators(str(path), robot), documents.read(path)
    count, source = integer("count", count, 1, 100_000), f"{path}: {KEY}"
    try:
        region = document["about"][KEY]
        names, rows = [tuple(name) for name in region["unknowns"]], region["correlation"]
        estimate, deviation = (
            np.array(region[key], float) for key in ("estimate", "standard_deviation")
        )
        correlation = np.zeros((len(names), len(names)))
        for at, row in enumerate(rows):
            correlation[at, : at + 1] = correlation[: at + 1, at] = row
        entries = tuple(
            Unknown(
                kind,
                robot.joint_names.index(place) if KINDS[kind].per == "joint" else None,
                0.0,
                1.0,
            )
            for kind, place in names
        )
        values, vectors = np.linalg.eigh(correlation)
        z = np.random.default_rng(seed).normal(size=(count, len(names)))
        points = estimate + deviation * (z @ (vectors * np.sqrt(np.maximum(values, 0.0))).T)
    except (KeyError, IndexError, TypeError, ValueError) as bad:
        remedy = "write the file with `batchpid identify` of this robot"
        raise InvalidArgumentError(
            source, f"is missing or cannot be read ({bad})", remedy=remedy
        ) from None
    columns = _columns(Unknowns(robot, tuple(range(robot.dof)), entries), points)
    return nominal.replace(**columns)
