"""Reports printed at the end of a run: its speed, a table of the joints, and problems."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from tabulate import tabulate

from batchpid.arrays.array_types import Rows
from batchpid.metrics import StepMetrics
from batchpid.sim import Robot, Rollout, Runner
from batchpid.sim.diagnosis.findings import settled_envs, short_words
from batchpid.sim.identification.setpoint_files import Setpoints
from batchpid.sim.robot.findings import Findings
from batchpid.sim.tuning.evaluation import Evaluation, arm_joints, following_error
from batchpid.task_space.frames import pose_error

NOT_SETTLED = 3
"""Exit status of `batchpid rollout` and `batchpid demo` where no env settles."""
SHORTEST = 1.0
"""Shortest run in which envs should settle [s]."""
LISTED = 5
"""Causes that a report lists."""


def table(rows: Sequence[Sequence[str]], headers: Sequence[str], align: str) -> str:
    """Return ``rows`` under ``headers`` as text; ``align`` has one letter per column, "l" or "r"."""
    sides = tuple("left" if side == "l" else "right" for side in align)
    return tabulate(rows, headers, disable_numparse=True, colalign=sides)


def run_report(runner: Runner, rollout: Rollout, metrics: StepMetrics, wall: float) -> str:
    """Return the report of a ``rollout`` of ``runner`` that took ``wall`` seconds."""
    speed = speed_line(rollout.num_envs, rollout.tick * len(rollout.time), runner.timestep, wall)
    findings = rollout.findings(runner.robot)
    outcome = "\n".join(outcome_lines(runner.robot, rollout, metrics, findings))
    return f"{speed}\n\n{joint_table(runner.robot, metrics, findings)}\n\n{outcome}"


def exit_status(robot: Robot, rollout: Rollout) -> int:
    """Return the exit status of a command that held a setpoint, :data:`NOT_SETTLED` if no env settled, else 0.

    In a run shorter than :data:`SHORTEST` an env only must not fail.
    """
    is_short = rollout.tick * len(rollout.time) < SHORTEST
    settled = rollout.ok.all(0) if is_short else settled_envs(rollout, robot)
    return 0 if settled.any() else NOT_SETTLED


def tool_report(runner: Runner, rollout: Rollout, wall: float) -> str:
    """Return the report of a ``rollout`` to a pose of the tool (7,) that took ``wall`` seconds."""
    speed = speed_line(rollout.num_envs, rollout.tick * len(rollout.time), runner.timestep, wall)
    assert rollout.tool_pose is not None
    error = pose_error(rollout.setpoint[..., :7], rollout.tool_pose.astype(float))
    rows = []
    for name, part in (("position [mm]", error[..., :3]), ("rotation [mrad]", error[..., 3:])):
        size = 1e3 * np.linalg.norm(part, axis=-1)
        ends = size[-max(1, len(size) // 10) :].max(0)
        rows.append([name, *(f"{np.median(each):.3g} / {each.max():.3g}" for each in (size[0], ends))])
    headers = ["median / worst env", "first error", "final error"]
    failed = np.flatnonzero(~rollout.ok.all(0))
    outcome = f"FAILED: {len(failed)} of {rollout.num_envs} envs, the first is env {failed[0]}." if len(failed) else ""
    about = f"Tool: {runner.options.tool}. final error: the largest in the last tenth of the run."
    causes = "\n".join(cause_lines(rollout.findings(runner.robot)))
    return f"{speed}\n\n{table(rows, headers, 'lrr')}\n\n{about}\n{outcome}\n{causes}".rstrip()


def trajectory_report(runner: Runner, rollout: Rollout, setpoints: Setpoints | None, wall: float) -> str:
    """Return the report of a ``rollout`` along a trajectory that took ``wall`` seconds.

    ``setpoints`` are those of the file, or None if their rates were not given.
    """
    robot, ticks = runner.robot, len(rollout.time)
    ends = rollout.for_ticks(slice(-max(1, ticks // 10), None))
    errors = [following_error(robot, each) for each in (rollout, ends)]
    saturated = rollout.saturated.mean((0, 1))
    rows = [
        [
            joint.name,
            *(f"{_cell(error[0, j], '.2g')} / {_cell(error[:, j].max(), '.2g')} {joint.unit}" for error in errors),
            "-" if runner.control == "drive" else f"{saturated[j]:.0%}",
        ]
        for j, joint in enumerate(robot.joints)
    ]
    rates = "Rates of the setpoints: from the file."
    if setpoints is None:
        rates = "Rates of the setpoints: not given."
    elif not setpoints.has_rates:
        rates = "Rates of the setpoints: central differences of the rows."
        if setpoints.steps:
            rates += f" {setpoints.steps} changes are too fast for the velocity limits: steps, with rate 0."
    lines = [
        speed_line(rollout.num_envs, rollout.tick * ticks, runner.timestep, wall) + "\n",
        table(rows, ["env 0 / worst env", "following error", "at the end", "saturated"], "lrrr"),
        "following error: the largest |qpos - setpoint| at the ends of ticks; at the end: in the last tenth;\n"
        "saturated: share of samples. Envs other than 0 start beside the trajectory.\n",
        rates,
        *_diverged_lines(rollout),
    ]
    return "\n".join(lines)


def speed_line(num_envs: int, simulated: float, timestep: float, wall: float) -> str:
    """Return the speed of a run: ``simulated`` seconds of ``num_envs`` robots in ``wall`` seconds."""
    factor = simulated / wall
    return (
        f"{num_envs * factor / timestep:,.0f} env-steps/s: {simulated:g} s of {num_envs} robots in {wall:.2f} s; "
        f"real-time factor {factor:.3g} per robot, {num_envs * factor:.3g} in total"
    )


def joint_table(robot: Robot, metrics: StepMetrics, findings: Findings) -> str:
    """Return a table with final error, overshoot, settling time and saturation of each joint over the envs.

    In place of the settling time of a joint that does not settle there is the cause in ``findings``.
    """
    metrics = _of_settled(metrics)
    median, worst = metrics.median(), metrics.worst()
    settled = np.isfinite(metrics.settling_time).sum(0)
    saturation = metrics.saturation_share.mean(0)

    def both(figure: str, joint: int, *style: str) -> str:
        return " / ".join(_cell(getattr(metrics, figure)[joint], *style) for metrics in (median, worst))

    rows = [
        [
            joint.name,
            f"{both('steady_state_error', j, '.2g')} {joint.unit}",
            both("overshoot", j, ".0%"),
            both("settling_time", j, ".2f", short_words(findings, joint.name), " s"),
            f"{settled[j]} of {len(metrics.settling_time)}",
            _cell(saturation[j], ".0%"),
        ]
        for j, joint in enumerate(robot.joints)
    ]
    headers = ["median / worst env", "final error", "overshoot", "settled after", "settled", "saturated"]
    return table(rows, headers, "lrrrrr") + (
        "\nfinal error: the largest in the last tenth of the run; settled: within 2 % of the move for good; "
        "saturated: share of samples; overshoot: of joints that settled"
    )


def outcome_lines(robot: Robot, rollout: Rollout, metrics: StepMetrics, findings: Findings) -> Iterator[str]:
    """Yield a line on envs that diverged, one on joints that did not settle, their causes, and :func:`limit_lines`."""
    seconds, diverged = rollout.tick * len(rollout.time), np.flatnonzero(~rollout.ok.all(0))
    yield from _diverged_lines(rollout)
    never = np.isinf(np.delete(metrics.settling_time, diverged, axis=0)).sum(0) * robot.independent
    unsettled = [f"{name} ({count})" for name, count in zip(robot.joint_names, never, strict=True) if count]
    if unsettled:
        yield f"NOT SETTLED within {seconds:g} s to 2 % of the move, with the number of envs: {', '.join(unsettled)}."
    if not diverged.size and not unsettled:
        yield f"Every joint of every env settled within {seconds:g} s to 2 % of its move."
    yield from cause_lines(findings)
    if all(each.code != "setpoint-limits" for each in findings):
        yield from limit_lines(robot, rollout.setpoint[-1])


def cause_lines(findings: Findings) -> Iterator[str]:
    """Yield a sentence for each of the first causes, the most likely first, with the joints or links that have it."""
    causes: dict[tuple[str, str], list[str]] = defaultdict(list)
    for each in findings:
        causes[each.text, each.remedy].append(f"{each.where} ({each.figures})")
    for number, ((text, remedy), places) in enumerate(list(causes.items())[:LISTED]):
        more = f" and {len(places) - LISTED} more" if len(places) > LISTED else ""
        yield f"{'and' if number else 'WHY'}: {text}: {', '.join(places[:LISTED])}{more}; {remedy}."
    if len(causes) > LISTED:
        yield f"... and {len(causes) - LISTED} more causes, which rollout.findings() lists."


def _diverged_lines(rollout: Rollout) -> Iterator[str]:
    """Yield a line on envs that diverged, if there are any."""
    diverged = np.flatnonzero(~rollout.ok.all(0))
    if diverged.size:
        first = rollout.tick * (1 + np.argmin(rollout.ok[:, diverged].all(1)))
        more = f" and {diverged.size - 8} more" if diverged.size > 8 else ""
        yield (
            f"DIVERGED: {diverged.size} of {rollout.num_envs} envs are no longer finite, the first after {first:.3g} "
            f"s: env {', '.join(map(str, diverged[:8]))}{more}."
        )


def limit_lines(robot: Robot, setpoint: Rows) -> Iterator[str]:
    """Yield a line for each joint with setpoints (envs, dof) out of its limits, with the worst; one line if none."""
    beyond = np.maximum(robot.lower - setpoint, setpoint - robot.upper)
    violations = robot.limit_violations(setpoint)
    for index in sorted({index for _, index, _ in violations}):
        joint, value = robot.joints[index], setpoint[beyond[:, index].argmax(), index]
        yield (
            f"OUT OF LIMITS: setpoint {value:g} {joint.unit} of {joint.name}, whose limits are "
            f"[{joint.lower:g}, {joint.upper:g}]: that error remains."
        )
    if not violations:
        yield "Setpoints out of limits: none."


def evaluation_table(robot: Robot, evaluations: Sequence[Evaluation]) -> str:
    """Return a table with one row per evaluation: median and worst over the arm's joints and all moves."""
    arm = arm_joints(robot)
    rows, causes = [], []
    for evaluation in evaluations:
        metrics, findings = _of_settled(evaluation.metrics), evaluation.rollout.findings(robot)
        names = {robot.joint_names[joint] for joint in np.flatnonzero(arm)}
        findings = Findings(each for each in findings if each.joint is None or each.joint in names)
        if findings:
            causes += [f"\nNot settled under {evaluation.name} (each env makes one move):", *cause_lines(findings)]
        settled = np.isfinite(metrics.settling_time[:, arm]).all(axis=1)
        in_time = np.where(arm, metrics.settling_time, 0).max(1) <= evaluation.settling_limit
        diverged = int((~evaluation.rollout.ok.all(0)).sum())
        followed = evaluation.following_error
        lost = np.full(1, np.nan) if followed is None else np.where(arm, followed, 0.0).max(1)
        rows.append(
            [
                evaluation.name,
                _median_and_worst(metrics.settling_time[:, arm], ".2f", " s", short_words(findings)),
                _median_and_worst(lost, ".2g"),
                _median_and_worst(metrics.overshoot[:, arm], ".1%"),
                _median_and_worst(metrics.steady_state_error[:, arm], ".1e"),
                _median_and_worst(evaluation.chatter[:, arm], ".1f"),
                f"{settled.sum()} / {in_time.sum()} of {len(evaluation.moves.start)}",
                str(diverged or "-"),
            ]
        )
    headers = ["gains", "settling", "following error", "overshoot", "final error", "chatter", "settled /\nin time"]
    if all(row[-1] == "-" for row in rows):
        rows = [row[:-1] for row in rows]
    else:
        headers.append("diverged")
    about = (
        "\nMedian / worst over the arm's joints and all moves, made as steps of the setpoint. following error: largest"
        "\n|qpos - setpoint| of a joint [rad or m] on the same moves as smooth motions, with setpoint rates. overshoot:"
        "\nof joints that settled. chatter: variation of the effort over that of the smooth move. settled / in time:"
        "\nmoves of which every joint settled, within the run and within a second or 1.2 times the shortest that the"
        "\neffort limits allow."
    )
    return table(rows, headers, "l" + "r" * (len(headers) - 1)) + about + "".join(f"\n{line}" for line in causes)


def motion_difference(robot: Robot, first: Evaluation, second: Evaluation) -> str:
    """Return a line with the largest difference of a position between two evaluations on the same moves."""
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


def _of_settled(metrics: StepMetrics) -> StepMetrics:
    """Return metrics whose overshoot is undefined where a joint did not settle, of which it says nothing."""
    unsettled = np.isinf(metrics.settling_time) & np.isfinite(metrics.overshoot)
    return metrics._replace(overshoot=np.where(unsettled, np.nan, metrics.overshoot))


def _median_and_worst(figure: Rows, style: str, unit: str = "", infinite: str = "never") -> str:
    if np.isnan(figure).all():
        return "-"
    return " / ".join(
        _cell(value, style, infinite, unit) for value in np.nanquantile(figure, [0.5, 1.0], method="higher")
    )


def _cell(value: float, style: str, infinite: str = "diverged", unit: str = "") -> str:
    return infinite if math.isinf(value) else "-" if math.isnan(value) else f"{value:{style}}{unit}"
