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
from batchpid.sim.identification.fit import INTERVAL, OUTLIER, STEP, Fit
from batchpid.sim.identification.simulator import LogControl, changed_params
from batchpid.sim.identification.unknowns import DESCRIBED, KINDS, Unknown, Unknowns
from batchpid.sim.robot.robot import Robot
from batchpid.sim.robot.robot_options import load_robot_actuators
from batchpid.sim.robot.urdf_export import to_urdf

if TYPE_CHECKING:
    from matplotlib.figure import Figure

KEY = "confidence_region"
"""Key of an actuators file, under "about"."""
LEAST_SHARE, LEAST_SHARE_OF_MASS = 0.1, 0.5
"""Least share of the remaining squared error that an effect, or the mass of a link, has to explain
to be named.
"""
EXPLAINS = 0.5
"""Share of the position error of the robot as described that a file may leave."""


@dataclass(frozen=True, eq=False)
class Identification:
    """Motors that explain the logs, with their uncertainty."""

    fit: Fit
    """The fit; ``fit.intervals`` are the intervals of ``unknowns``."""
    still: tuple[str, ...]
    """Joints that did not move."""

    @cached_property
    def errors(self) -> tuple[Float64, Float64, Float64]:
        """Root mean square of the position error by joint (joints,) on the held-out part of the
        logs: of the robot as described and as identified, simulated from the logged state, and the
        latter with the initial state of each window fitted.
        """
        problem = self.fit.problem
        point = self.fit.solution.point
        described = replace(problem, unknowns=replace(problem.unknowns, entries=()))
        return (
            described.error(np.zeros(0), free_states=False),
            problem.error(point, free_states=False),
            problem.error(point),
        )

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
        """Values of the unknowns (unknowns,)."""
        values: Float64 = self.unknowns.values(self.fit.solution.point[None])[0]
        return values

    @property
    def held_out_error(self) -> tuple[float, float]:
        """Root mean square of the position error [rad or m] on the held-out part of the logs,
        simulated from the logged state, of the robot as described and as identified.
        """
        return _rms(self.errors[0]), _rms(self.errors[1])

    @property
    def explains(self) -> bool:
        """True if less than half of the error of the robot as described is left."""
        before, after = self.held_out_error
        return after < EXPLAINS * before

    @property
    def converged(self) -> bool:
        """False if the fit has stopped at the largest number of evaluations."""
        return self.fit.solution.converged

    @property
    def not_identified(self) -> list[str]:
        """Unknowns that the logs do not identify, e.g. "elbow: strength"."""
        return [self._name(entry) for entry in self.fit.hidden.entries]

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
        entries = self.unknowns.entries + self.fit.hidden.entries
        for at, entry in enumerate(entries):
            if (entry.kind, entry.link or entry.joint) == (kind, joint):
                return self.row(at) if at < len(self.unknowns.entries) else None
        kinds = ", ".join(sorted({entry.kind for entry in entries}))
        problem = f"is no unknown of {joint!r}"
        raise InvalidArgumentError("kind", problem, value=kind, remedy=f"there are {kinds}")

    def row(self, at: int) -> tuple[float, float, float]:
        """Return the interval of an unknown by its place among :attr:`unknowns`."""
        entry = self.unknowns.entries[at]
        value = float(self.values[at])
        half = INTERVAL * float(self.fit.intervals.deviation[at])
        low = value - half
        if KINDS[entry.kind].positive:
            low = max(low, entry.floor)
        return value, low, value + half

    def _place(self, entry: Unknown) -> str | None:
        """Return the joint or link of an unknown."""
        if entry.joint is None:
            return entry.link
        return self.robot.joint_names[self.joints[entry.joint]]

    def _name(self, entry: Unknown) -> str:
        place = self._place(entry)
        return entry.kind if place is None else f"{place}: {entry.kind}"

    def actuators(self) -> bp.Actuators:
        """Return the identified actuators; joints that are not in the logs are ideal.

        Friction and damping are in addition to the robot's description.
        """
        columns = _columns(self.unknowns, self.values[None])
        options: dict[str, Any] = {name: column[0] for name, column in columns.items()}
        return bp.make_actuators(self.robot.dof, **options, joint_names=self.robot.joint_names)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write :meth:`actuators` to a .yaml or .json file, with intervals, errors and the
        confidence region; and :meth:`gains`, if the law was identified, to NAME-gains.yaml.
        """
        region = {
            "unknowns": [[entry.kind, self._place(entry)] for entry in self.unknowns.entries],
            "estimate": self.values.tolist(),
            "root": self.fit.intervals.root.tolist(),
        }
        about = self.document() | {KEY: region}
        bp.save_actuators(path, self.actuators(), self.robot.joint_names, about)
        gains = self.gains()
        if gains is not None:
            names = [self.robot.joint_names[joint] for joint in self.joints]
            bp.save_params(Path(path).with_name(f"{Path(path).stem}-gains.yaml"), gains, names)

    def document(self) -> Document:
        """Return the result as plain values: estimate and 95 % interval of each unknown, and the
        errors.
        """
        intervals: Document = {}
        for at, entry in enumerate(self.unknowns.entries):
            place = self._place(entry)
            table = intervals if place is None else intervals.setdefault(place, {})
            table[entry.kind] = list(self.row(at))
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
        law = self.unknowns.candidates(self.values[None]).law
        if self.drive.params is None or law.keys().isdisjoint(("gain", "kd", "saturation")):
            return None
        return changed_params(self.drive.params, law)

    def figure(self) -> Figure:
        """Return a picture of the position errors along the first log, before and after."""
        from batchpid.sim import plots

        windows = [window for window in self.fit.problem.windows if window.log == 0]
        after = replace(self.fit.problem, windows=windows)
        before = replace(after, unknowns=replace(self.unknowns, entries=()))
        tables = []
        for problem, point in ((before, np.zeros(0)), (after, self.fit.solution.point)):
            still = np.zeros((0, len(point)))
            tables.append(problem.evaluate(point, still, free_states=False, held_out=True))
        errors = []
        for window, first, last in zip(windows, *tables, strict=True):
            errors.append((window.time, window.fitted, first[..., 0], last[..., 0]))
        names = [self.robot.joint_names[joint] for joint in self.joints]
        units = [self.robot.units[joint] for joint in self.joints]
        title = f"{self.robot.name}: position error, shaded where it was not fitted"
        return plots.fit_errors(errors, names, units, title)

    def report(self) -> str:
        """Return values, intervals and errors as text."""
        rows = dict[str | None, list[str]]()
        for at, entry in enumerate(self.unknowns.entries):
            rows.setdefault(self._place(entry), []).append(f"{entry.kind} {self._cell(at)}")
        lines = ["values with 95 % intervals, SI units"]
        lines += [f"{place or 'robot'}: {', '.join(cells)}" for place, cells in rows.items()]
        if self.drive.compensate != "none":
            path = "through its motors" if self.drive.through else "apart from its motors"
            friction = "" if self.drive.modelled is None else "+friction"
            lines.append(f"the robot compensates {self.drive.compensate}{friction} {path}")
        before, after = self.held_out_error
        lines.append(
            "position error on the held-out part, simulated from the logged state:"
            f" {before:.3g} as described, {after:.3g} with these"
        )
        if self.drive.params is None:
            free = _rms(self.errors[2])
            lines.append(f"with the initial state of each 0.3 s fitted: {free:.3g}")
        joints = zip(self.joints, self.errors[1], strict=True)
        errors = [f"{self.robot.joint_names[joint]} {error:.2g}" for joint, error in joints]
        lines.append(f"by joint: {', '.join(errors)}")
        if self.not_identified:
            names = ", ".join(self.not_identified)
            lines.append(f"not shown by these logs or not needed, hence as described: {names}")
        if not self.converged:
            lines.append("the fit has not converged: the values are the best so far")
        return "\n".join([*lines, self.advice])

    def _cell(self, at: int) -> str:
        value, _, high = self.row(at)
        half = high - value
        if half > abs(value) and KINDS[self.unknowns.entries[at].kind].positive:
            return f"< {high:.2g}"
        # As many digits as the first one of the interval has, and one more.
        digits = np.log10(max(abs(value), half) / half)
        return f"{value:.{1 + int(np.ceil(digits))}g} ± {half:.1g}"


def _rms(errors: Float64) -> float:
    return float(np.sqrt((errors**2).mean()))


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
            table = np.clip(table - described, 1e-3 * kind.neutral, kind.most)
        column = np.full((len(values), robot.dof), kind.neutral)
        column[:, joints] = table
        if kind.per == "robot":
            column[:] = table[:, :1]
        columns[kind.field] = column
    if "static" in columns:
        columns["static"] += columns.get("coulomb", 0.0)
    return columns


def advice(fit: Fit) -> str:
    """Return a sentence on the effect that would explain most of the remaining error of a fit, by
    its derivatives: each further effect is added alone to the unknowns of the fit.
    """
    problem = fit.problem
    unknowns = problem.unknowns
    links = problem.data[0].plant.heavy_links
    further = [Unknown("mass", None, 1.0, 1.0, link=link) for link in links]
    for joint in range(len(unknowns.joints)):
        further.append(Unknown("offset", joint, 0.0, 0.01))
        further.append(Unknown("load_friction", joint, 1e-6, 1e-5))
    present = {entry.kind for entry in unknowns.entries}
    further = [entry for entry in further if entry.kind not in present]
    names = [(entry.kind, entry.link) for entry in further]
    point = np.append(fit.solution.point, [entry.coordinate(entry.start) for entry in further])
    wide = replace(problem, unknowns=replace(unknowns, entries=(*unknowns.entries, *further)))
    evaluation = wide.evaluate(point, STEP * np.eye(len(point)))
    residual, matrix = wide.system(evaluation, point, fit.solution.size)
    # Without the prior of the further unknowns: any size of an effect is as likely.
    rows = len(residual) - len(further)
    table = np.column_stack([matrix, residual])[:rows]
    weight = (1 + (residual[:rows] / OUTLIER) ** 2) ** -0.25
    triangle: Any = np.linalg.qr(weight[:, None] * table, mode="r")
    target = triangle[:, -1]
    # Share of the squared error that each effect explains, and the changes of the unknowns.
    effects = dict[tuple[str, str | None], tuple[float, Float64]]()
    for name in dict.fromkeys(names):
        columns = [True] * len(unknowns.entries) + [other == name for other in names]
        slopes = triangle[:, :-1][:, columns]
        change, *_ = np.linalg.lstsq(slopes, -target, rcond=1e-10)
        share = 1 - float(((target + slopes @ change) ** 2).sum() / (target @ target))
        if share > (LEAST_SHARE if name[1] is None else LEAST_SHARE_OF_MASS):
            effects[name] = share, change
    if not effects:
        return "no further effect that was tried would explain a tenth of the remaining error"
    kind, link = max(effects, key=lambda name: effects[name][0])
    if link is None:
        percent = 100 * effects[kind, link][0]
        return f"{kind} would explain {percent:.0f} % of the squared error (extras: {kind})"
    # A heavier link looks like a lighter other one with weaker motors: take factors near 1.
    factors = [KINDS[entry.kind].neutral == 1.0 for entry in (*unknowns.entries, further[0])]
    sizes = dict[float, str]()
    for (_, link), (_, change) in effects.items():
        if link is not None:
            values = np.append(fit.solution.point, 1.0) + change
            more = "heavier" if change[-1] > 0 else "lighter"
            sizes[float(np.abs(values - 1)[factors].sum())] = f"{link} {more}"
    words = f"link {sizes[min(sizes)]} than described would explain most of the error"
    return f"{words} (extras: mass), or the strengths: weigh it"


def draw_motors(
    path: str | os.PathLike[str], robot: Robot, count: int, seed: int = 0
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
            joint = robot.joint_names.index(place) if KINDS[kind].per == "joint" else None
            entries.append(Unknown(kind, joint, 0.0, 1.0))
        normal = np.random.default_rng(seed).normal(size=(count, len(entries)))
        points = region["estimate"] + normal @ np.transpose(region["root"])
    except (KeyError, IndexError, TypeError, ValueError) as bad:
        problem = f"is missing or cannot be read ({bad})"
        remedy = "write the file with `batchpid identify` of this robot"
        raise InvalidArgumentError(f"{path}: {KEY}", problem, remedy=remedy) from None
    unknowns = Unknowns(robot, tuple(range(robot.dof)), tuple(entries))
    return nominal.replace(**_columns(unknowns, points))
