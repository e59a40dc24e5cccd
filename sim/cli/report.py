"""Reports of runs and evaluations: figures of each joint or axis, tables, failed envs, and
causes.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
from tabulate import tabulate

from batchpid.arrays.array_types import Document, Rows
from batchpid.sim import Finding, Robot, Rollout, Runner
from batchpid.sim.diagnosis.findings import settled_envs
from batchpid.sim.tuning.evaluation import (
    Evaluation,
    arm_joints,
    following_error,
    step_response_metrics,
)
from batchpid.task_space.frames import pose_error

NOT_SETTLED = 3
"""Exit status of `batchpid rollout` and `batchpid demo` where no env settles."""
SHORTEST = 1.0
"""Shortest run in which envs should settle [s]."""
LISTED = 3
"""Causes that a report lists."""
AXES = {"x": "m", "y": "m", "z": "m", "rx": "rad", "ry": "rad", "rz": "rad"}
"""Axes of the error of a pose, with their units."""
COLUMNS = {
    "first_error": ("first error", "{:.2g}"),
    "following_error": ("following error", "{:.2g}"),
    "steady_state_error": ("final error", "{:.2g}"),
    "final_error": ("final error", "{:.2g}"),
    "overshoot": ("overshoot", "{:.0%}"),
    "settling_time": ("settled after", "{:.2f} s"),
    "saturation_share": ("saturated", "{:.0%}"),
}
"""Figures in the table of a run, with headers and styles."""
ABOUT = """\
final error: the largest in the last tenth of the run; following error: the largest |qpos - setpoint| at the ends of
ticks; settled: within 2 % of the move for good; overshoot: of joints that settled; saturated: share of samples
"""
ABOUT_SETS = """\
Median / worst over the arm's joints and all moves, made as steps of the setpoint. following error: largest
|qpos - setpoint| of a joint [rad or m] on the same moves as smooth motions, with setpoint rates. overshoot: of joints
that settled. chatter: variation of the effort over that of the smooth move. settled / in time: moves of which every
joint settled, within the run and within a second or 1.2 times the shortest that the effort limits allow."""


def table(rows: Sequence[Sequence[str]], headers: Sequence[str], align: str) -> str:
    """Return ``rows`` under ``headers`` as text; ``align`` has one letter per column, "l" or
    "r".
    """
    sides = tuple("left" if side == "l" else "right" for side in align)
    return tabulate(rows, headers, disable_numparse=True, colalign=sides)


def run_columns(
    robot: Robot, rollout: Rollout
) -> tuple[Sequence[str], Sequence[str], dict[str, Rows]]:
    """Return the names and units of a run's joints, or of the axes of its tool, and their figures
    (envs, joints).

    The figures are errors of a tool's pose, following errors of setpoints that move, or metrics of
    steps.
    """
    info, ticks = rollout.info, len(rollout.time)
    ends = slice(-max(1, ticks // 10), None)
    if rollout.tool_pose is not None:
        error = np.abs(pose_error(rollout.setpoint[..., :7], rollout.tool_pose.astype(float)))
        return (
            list(AXES),
            list(AXES.values()),
            {"first_error": error[0], "final_error": error[ends].max(0)},
        )
    if ticks < 2 or (rollout.setpoint != rollout.setpoint[0]).any():
        errors = [following_error(robot, part) for part in (rollout, rollout.for_ticks(ends))]
        columns = dict(zip(("following_error", "final_error"), errors, strict=True))
        if info.control != "drive":
            columns["saturation_share"] = rollout.saturated.mean(0)
    else:
        start = robot.start if info.start is None else info.start.astype(np.float64)
        metrics = step_response_metrics(robot, rollout, start, with_effort=info.control != "drive")
        columns = metrics._asdict() | {
            "overshoot": _of_settled(metrics.overshoot, metrics.settling_time)
        }
    return robot.joint_names, robot.units, columns


def run_figures(robot: Robot, rollout: Rollout) -> Document:
    """Return the figures of a run for --json: lists by env."""
    names, units, columns = run_columns(robot, rollout)
    rows = {
        name: {"unit": unit} | {column: figures[:, row] for column, figures in columns.items()}
        for row, (name, unit) in enumerate(zip(names, units, strict=True))
    }
    about = {
        name: getattr(rollout.info, name)
        for name in ("robot", "control", "tool", "engine", "physics")
    }
    failed = np.flatnonzero(~rollout.ok.all(0))
    seconds = rollout.tick * len(rollout.time)
    return about | {
        "num_envs": rollout.num_envs,
        "seconds": seconds,
        "failed": failed,
        "joints": rows,
    }


def run_report(runner: Runner, rollout: Rollout, wall: float) -> str:
    """Return the report of a ``rollout`` of ``runner`` that took ``wall`` seconds."""
    robot = runner.robot
    seconds = rollout.tick * len(rollout.time)
    count = rollout.num_envs
    names, units, columns = run_columns(robot, rollout)
    shown = {name: COLUMNS[name] for name in COLUMNS if name in columns}
    rows = [
        [
            f"{name} [{unit}]",
            *(_pair(columns[column][:, row], style) for column, (_, style) in shown.items()),
        ]
        for row, (name, unit) in enumerate(zip(names, units, strict=True))
    ]
    headers = ["median / worst env", *(header for header, _ in shown.values())]
    lines = [
        speed_line(count, seconds, runner.timestep, wall) + "\n",
        table(rows, headers, "l" + "r" * len(shown)),
        ABOUT,
    ]
    failed = np.flatnonzero(~rollout.ok.all(0))
    if failed.size:
        first = rollout.tick * (1 + np.argmin(rollout.ok.all(1)))
        more = f" and {failed.size - 8} more" if failed.size > 8 else ""
        envs = ", ".join(map(str, failed[:8]))
        lines.append(
            f"FAILED: {failed.size} of {count} envs, the first after {first:.3g} s: env"
            f" {envs}{more}."
        )
    if "settling_time" in columns:
        never = (
            np.isinf(np.delete(columns["settling_time"], failed, axis=0)).sum(0) * robot.independent
        )
        unsettled = [f"{name} ({envs})" for name, envs in zip(names, never, strict=True) if envs]
        if unsettled:
            where = ", ".join(unsettled)
            lines.append(
                f"NOT SETTLED within {seconds:g} s to 2 % of the move, with the number of envs:"
                f" {where}."
            )
        elif not failed.size:
            lines.append(
                f"Every joint of every env settled within {seconds:g} s to 2 % of its move."
            )
    findings = [] if "following_error" in columns else rollout.findings(robot)
    return "\n".join([*lines, *cause_lines(findings)])


def speed_line(num_envs: int, simulated: float, timestep: float, wall: float) -> str:
    """Return the speed of a run: ``simulated`` seconds of ``num_envs`` robots in ``wall``
    seconds.
    """
    factor = simulated / wall
    return (
        f"{num_envs * factor / timestep:,.0f} env-steps/s: {simulated:g} s of {num_envs} robots in"
        f" {wall:.2f} s; real-time factor {factor:.3g} per robot, {num_envs * factor:.3g} in total"
    )


def cause_lines(findings: Sequence[Finding]) -> Iterator[str]:
    """Yield a line for each of the first causes, the most likely first."""
    for cause in findings[:LISTED]:
        yield f"WHY: {cause.where}: {cause.text} ({cause.figures}); {cause.remedy}."
    if len(findings) > LISTED:
        yield f"... and {len(findings) - LISTED} more, which rollout.findings() lists."


def exit_status(robot: Robot, rollout: Rollout) -> int:
    """Return the exit status of a command that held a setpoint, :data:`NOT_SETTLED` if no env
    settled, else 0.

    In a run shorter than :data:`SHORTEST` an env only must not fail.
    """
    is_short = rollout.tick * len(rollout.time) < SHORTEST
    settled = rollout.ok.all(0) if is_short else settled_envs(rollout, robot)
    return 0 if settled.any() else NOT_SETTLED


def evaluation_table(robot: Robot, evaluations: Iterable[Evaluation]) -> str:
    """Return a table with one row per evaluation: median and worst over the arm's joints and all
    moves.
    """
    arm = arm_joints(robot)
    rows = []
    causes = list[str]()
    for evaluation in evaluations:
        metrics, error = evaluation.metrics, evaluation.following_error
        settling, count = metrics.settling_time[:, arm], len(evaluation.moves.start)
        settled = np.isfinite(settling).all(1).sum()
        in_time = (
            np.nan_to_num(settling, nan=0.0, posinf=np.inf).max(1) <= evaluation.settling_limit
        ).sum()
        rows.append(
            [
                evaluation.name,
                _pair(settling, "{:.2f} s"),
                "-" if error is None else _pair(error[:, arm].max(1), "{:.2g}"),
                _pair(_of_settled(metrics.overshoot[:, arm], settling), "{:.1%}"),
                _pair(metrics.steady_state_error[:, arm], "{:.1e}"),
                _pair(evaluation.chatter[:, arm], "{:.1f}"),
                f"{settled} / {in_time} of {count}",
            ]
        )
        names = {None, *np.array(robot.joint_names)[arm]}
        if findings := [
            finding for finding in evaluation.rollout.findings(robot) if finding.joint in names
        ]:
            causes += [
                f"\nNot settled under {evaluation.name} (each env makes one move):",
                *cause_lines(findings),
            ]
    headers = [
        "gains",
        "settling",
        "following error",
        "overshoot",
        "final error",
        "chatter",
        "settled /\nin time",
    ]
    return "\n".join([table(rows, headers, "lrrrrrr"), ABOUT_SETS, *causes])


def motion_difference(robot: Robot, first: Evaluation, second: Evaluation) -> str:
    """Return a line with the largest difference of a position between two evaluations on the same
    moves.
    """
    apart = np.nan_to_num(np.abs(first.rollout.qpos - second.rollout.qpos), nan=np.inf).max(0)
    move, joint = np.unravel_index(int(apart.argmax()), apart.shape)
    place = f"joint {robot.joint_names[joint]!r}, move {first.moves.names[move]!r}"
    return f"  {first.name} / {second.name}: {apart.max():.1e} {robot.units[joint]} ({place})"


def draw_first_move(robot: Robot, evaluations: Sequence[Evaluation], path: Path) -> Path:
    """Draw the first two ``evaluations`` on their first move to ``path``, and return it."""
    from batchpid.sim import plots

    first, second = evaluations[:2]
    runs = [evaluation.rollout.for_envs(slice(0, 1)) for evaluation in (first, second)]
    title = f"{robot.name}, {first.moves.names[0]} move"
    return plots.save(plots.comparison(*runs, labels=(first.name, second.name), title=title), path)


def _of_settled(overshoot: Rows, settling: Rows) -> Rows:
    """Return the overshoots of joints that settled; of others, which have none to speak of, NaN."""
    return np.where(np.isinf(settling) & np.isfinite(overshoot), np.nan, overshoot)


def _pair(figures: Rows, style: str) -> str:
    """Return the median and the worst of ``figures``, "never" for infinity, and "-" where none is
    defined.
    """
    if np.isnan(figures).all():
        return "-"
    quantiles = np.nanquantile(figures, [0.5, 1.0], method="higher")
    return " / ".join("never" if math.isinf(value) else style.format(value) for value in quantiles)
