"""Result of an identification: values with intervals, a report, an actuators file, and draws from
its region.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import batchpid as bp
from batchpid.arrays.array_types import Document, Float64
from batchpid.checks.validate import integer
from batchpid.errors import InvalidArgumentError
from batchpid.io import documents
from batchpid.sim.identification.fit import INTERVAL, STEP, Fit, Problem, downweighted
from batchpid.sim.identification.simulator import LogControl, changed_params
from batchpid.sim.identification.unknowns import DESCRIBED, KINDS, Unknown, Unknowns
from batchpid.sim.robot.robot import Robot
from batchpid.sim.robot.robot_options import load_robot_actuators
from batchpid.sim.robot.urdf_export import to_urdf

if TYPE_CHECKING:
    from matplotlib.figure import Figure

KEY = "confidence_region"
"""Key of an actuators file, under "about"."""
LEAST_SHARE = 0.1
"""Least share of the remaining squared error that an effect has to explain to be named."""
ALIKE = 0.5
"""Share of the best explanation from which another link is as likely."""
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
        return self._described.error(np.zeros(0)), problem.error(self.fit.point)

    @property
    def _described(self) -> Problem:
        """The problem without unknowns."""
        return replace(self.fit.problem, unknowns=replace(self.unknowns, entries=()))

    @cached_property
    def advice(self) -> str:
        """Sentence on an effect that would lower the error most, or on its absence."""
        return advice(self.fit)

    @property
    def unknowns(self) -> Unknowns:
        """Unknowns that the logs show."""
        return self.fit.problem.unknowns

    @property
    def robot(self) -> Robot:
        """The robot, at rest where it did not move."""
        return self.unknowns.robot

    @property
    def joints(self) -> tuple[int, ...]:
        """Numbers of the joints that the logs hold and that moved."""
        return self.unknowns.joints

    @property
    def drive(self) -> LogControl:
        """Control of the first log."""
        return self.fit.problem.data[0].drive

    @property
    def values(self) -> Float64:
        """Values of the unknowns (unknowns,), in addition to the robot's description."""
        return self.unknowns.values(self.fit.point)

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
    def not_identified(self) -> list[str]:
        """Unknowns that the logs do not identify, e.g. "elbow: strength"."""
        return [f"{self._place(entry) or 'robot'}: {entry.kind}" for entry in self.fit.hidden]

    def interval(
        self, kind: str, joint: int | str | None = None
    ) -> tuple[float, float, float] | None:
        """Return estimate, lower and upper end of the 95 % interval; None if the logs do not
        identify it.

        Friction and damping include the description's. ``kind`` is a name of
        :data:`batchpid.sim.identification.unknowns.KINDS`, ``joint`` the number of a joint among
        :attr:`joints`, the name of a link for "mass", None for "delay", "setpoint_delay" and
        "payload".

        Raises
        ------
        InvalidArgumentError
            There is no such unknown.
        """
        entries = [*self.unknowns.entries, *self.fit.hidden]
        names = [(entry.kind, entry.link or entry.joint) for entry in entries]
        if (kind, joint) not in names:
            problem = f"is no unknown of {joint!r}"
            remedy = f"there are {sorted({entry.kind for entry in entries})}"
            raise InvalidArgumentError("kind", problem, value=kind, remedy=remedy)
        rows = dict(zip(names, self._rows, strict=False))
        return rows.get((kind, joint))

    @property
    def _rows(self) -> list[tuple[float, float, float]]:
        """Estimate and ends of the interval of each unknown."""
        rows = list[Any]()
        halves = INTERVAL * self.fit.deviation
        for entry, value, half in zip(self.unknowns.entries, self.values, halves, strict=True):
            low = max(value - half, 0.0) if KINDS[entry.kind].positive else value - half
            described = 0.0
            if entry.kind in DESCRIBED and entry.joint is not None:
                table = getattr(self.robot, DESCRIBED[entry.kind])
                described = table[self.joints[entry.joint]]
            row = value, low, value + half
            rows.append(tuple(float(described + number) for number in row))
        return rows

    def _place(self, entry: Unknown) -> str | None:
        """Return the joint or link of an unknown."""
        if entry.joint is None:
            return entry.link
        return self.robot.joint_names[self.joints[entry.joint]]

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
            "root": self.fit.root.tolist(),
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
        for entry, row in zip(self.unknowns.entries, self._rows, strict=True):
            intervals.setdefault(self._place(entry) or "robot", {})[entry.kind] = list(row)
        return {
            "intervals": intervals,
            "not_shown": self.not_identified,
            "did_not_move_hence_ideal": list(self.still),
            "held_out_error": list(self.held_out_error),
            "converged": self.converged,
            "compensation_through_motors": self.drive.through,
            "identified_from": [part.log.source for part in self.fit.problem.data],
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
            remedy = "identify with extras=['mass']"
            raise InvalidArgumentError("corrected_urdf", "no mass was found", remedy=remedy)
        return to_urdf(self.robot, mass_factors=factors).text

    def gains(self) -> bp.PIDParams | None:
        """Return the params of the identified law, of the logged joints; None without unknowns of
        the law.
        """
        law = self.unknowns.tables(self.values[None], "law")
        if self.drive.params is None or law.keys() <= {"slew"}:
            return None
        return changed_params(self.drive.params, law)

    def figure(self) -> Figure:
        """Return a picture of the position errors along the first log, before and after."""
        from batchpid.sim import plots

        windows = [window for window in self.fit.problem.windows if window.log == 0]
        tables = []
        for problem in (self._described, self.fit.problem):
            point = self.fit.point[: len(problem.unknowns.entries)]
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
        if self.drive.compensate != "none":
            path = "through its motors" if self.drive.through else "apart from its motors"
            friction = "" if self.drive.modelled is None else "+friction"
            lines.append(f"the robot compensates {self.drive.compensate}{friction} {path}")
        before, after = self.held_out_error
        lines.append(
            "position error on the held-out part, simulated from the logged state:"
            f" {before:.3g} as described, {after:.3g} with these"
        )
        joints = zip(self.joints, self.errors[1], strict=True)
        errors = [f"{self.robot.joint_names[joint]} {error:.2g}" for joint, error in joints]
        lines.append(f"by joint: {', '.join(errors)}")
        if self.not_identified:
            names = ", ".join(self.not_identified)
            lines.append(f"not shown by these logs or not needed, hence as described: {names}")
        if not self.converged:
            lines.append("the fit has not converged: the values are the best so far")
        return "\n".join([*lines, self.advice])


def _cell(
    kind: str,
    value: float,
    low: float,
    high: float,
) -> str:
    """Return a value with its interval, or its bound where the interval is wider than itself."""
    half = high - value
    if half > abs(value) and KINDS[kind].positive:
        return f"< {high:.2g}"
    # As many digits as the first one of the interval has, and one more.
    digits = np.log10(max(abs(value), half) / half)
    return f"{value:.{1 + int(np.ceil(digits))}g} ± {half:.1g}"


def _of_all_joints(unknowns: Unknowns, values: Float64) -> dict[str, Float64]:
    """Return the fields of actuators (n, dof) with ``values`` (n, unknowns)."""
    fields = dict[str, Float64]()
    neutral = {kind.field: kind.neutral for kind in KINDS.values()}
    for name, table in unknowns.tables(values, "motor").items():
        fields[name] = np.full((len(values), unknowns.robot.dof), neutral[name])
        fields[name][:, unknowns.joints] = table
        # A delay is that of the whole robot.
        if name == "command_delay":
            fields[name][:] = table[:, :1]
    return fields


def advice(fit: Fit) -> str:
    """Return a sentence on the effect that would explain most of the remaining error of a fit, by
    its derivatives: each further effect is added alone to the unknowns of the fit.
    """
    problem = fit.problem
    unknowns = problem.unknowns
    entries = unknowns.entries
    present = {entry.kind for entry in entries}
    kinds = [kind for kind in ("mass", "offset", "load_friction") if kind not in present]
    links = problem.data[0].plant.heavy_links
    starts = {"load_friction": np.zeros(len(unknowns.joints))}
    further = Unknowns.of(unknowns.robot, unknowns.joints, kinds, starts, {}, links).entries
    wide = replace(unknowns, entries=(*entries, *further))
    values = np.append(unknowns.values(fit.point), [entry.start for entry in further])
    problem = replace(problem, unknowns=wide)
    point = wide.points(values)
    evaluation = problem.evaluate(point, STEP * np.eye(len(point)))
    residual, matrix = problem.system(point, evaluation, fit.size)
    # Without the prior of the further unknowns: any size of an effect is as likely.
    rows = len(residual) - len(further)
    table = downweighted(np.column_stack([residual, matrix])[:rows])
    triangle: Any = np.linalg.qr(table, mode="r")
    target = -triangle[:, 0]
    names = np.array([entry.link or entry.kind for entry in wide.entries])
    is_factor = np.array([kind.neutral == 1.0 for kind in wide.kinds])
    effects = []
    for name in dict.fromkeys(names[len(entries) :].tolist()):
        columns = names == name
        columns[: len(entries)] = True
        slopes = triangle[:, 1:][:, columns]
        change, *_ = np.linalg.lstsq(slopes, target, rcond=1e-10)
        share = 1 - float(((target - slopes @ change) ** 2).sum() / (target @ target))
        factors = (values[columns] + change)[is_factor[columns]]
        effects.append((share, float(np.abs(factors - 1).sum()), name, change[-1]))
    share, _, name, _ = max(effects, default=(0.0, 0.0, "", 0.0))
    if share < LEAST_SHARE:
        return "no further effect that was tried would explain a tenth of the remaining error"
    words = "would explain {:.0f} % of the squared error (extras: {})"
    if name in KINDS:
        return f"{name} {words.format(100 * share, name)}"
    # A heavier link looks like a lighter other one with weaker motors: take factors near 1.
    alike = [effect for effect in effects if effect[0] > ALIKE * share and effect[2] not in KINDS]
    share, _, name, size = min(alike, key=lambda effect: effect[1])
    more = "heavier" if size > 0 else "lighter"
    words = words.format(100 * share, "mass")
    return f"link {name} {more} than described {words}, or the strengths: weigh it"


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
    nominal = load_robot_actuators(str(path), robot.joints)
    try:
        region = documents.read(path)["about"][KEY]
        entries = []
        for kind, place in region["unknowns"]:
            joint = robot.joint_names.index(place) if KINDS[kind].per == "joint" else None
            entries.append(Unknown(kind, joint, 0.0, 1.0))
        normal = np.random.default_rng(seed).normal(size=(count, len(entries)))
        values = region["estimate"] + normal @ np.transpose(region["root"])
    except (KeyError, IndexError, TypeError, ValueError) as bad:
        problem = f"is missing or cannot be read ({bad})"
        remedy = "write the file with `batchpid identify` of this robot"
        raise InvalidArgumentError(f"{path}: {KEY}", problem, remedy=remedy) from None
    unknowns = Unknowns(robot, tuple(range(robot.dof)), tuple(entries))
    for column, kind in enumerate(unknowns.kinds):
        if kind.positive:
            values[:, column] = values[:, column].clip(1e-3 * kind.neutral, kind.most)
    return nominal.replace(**_of_all_joints(unknowns, values))
