"""What a run says of itself at its end: speed, the joints one by one, and what went wrong."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from batchpid.metrics import StepMetrics

if TYPE_CHECKING:
    from sim import Robot, Rollout
    from sim.tuning.evaluation import Evaluation


def table(rows: list[list[str]], headers: list[str], align: str) -> str:
    """``rows`` under ``headers`` as text; ``align`` has one letter a column, "l" or "r"."""
    from tabulate import tabulate

    sides = tuple("left" if side == "l" else "right" for side in align)
    return tabulate(rows, headers, disable_numparse=True, colalign=sides)


def speed(num_envs: int, steps: int, timestep: float, wall: float) -> str:
    """``steps`` sim steps of ``num_envs`` robots took ``wall`` seconds."""
    factor = steps * timestep / wall
    return (
        f"{num_envs * steps / wall:,.0f} env-steps/s: {steps * timestep:g} s of {num_envs} robots in {wall:.2f} s; "
        f"real-time factor {factor:.3g} ({num_envs * factor:.3g} robot-seconds a second)"
    )


def joint_table(robot: Robot, metrics: StepMetrics) -> str:
    """Final error, overshoot, settling time and saturation of each joint: median and worst over envs."""
    median, worst = metrics.median(), metrics.worst()
    envs = len(metrics.settling_time)
    settled = np.isfinite(metrics.settling_time).sum(0)
    saturation = np.nan_to_num(metrics.saturation_share).mean(0)
    rows = [
        [
            joint.name,
            f"{_number(median.steady_state_error[j])} / {_number(worst.steady_state_error[j])} {joint.unit}",
            f"{_percent(median.overshoot[j])} / {_percent(worst.overshoot[j])}",
            f"{_seconds(median.settling_time[j])} / {_seconds(worst.settling_time[j])}",
            f"{settled[j]} of {envs}",
            _percent(saturation[j]),
        ]
        for j, joint in enumerate(robot.joints)
    ]
    headers = ["median / worst env", "final error", "overshoot", "settled after", "settled", "saturated"]
    return table(rows, headers, "lrrrrr") + (
        "\nfinal error: the largest in the last tenth of the run; settled: within 2 % of the move for good; "
        "saturated: share of samples"
    )


def verdicts(robot: Robot, rollout: Rollout, metrics: StepMetrics) -> Iterator[str]:
    """What a reader must know: envs that diverged, joints that do not settle, setpoints out of reach."""
    seconds = rollout.time[-1]
    dead = np.flatnonzero(~rollout.ok.all(0))
    envs = rollout.ok.shape[1]
    if dead.size:
        first = rollout.time[np.argmin(rollout.ok[:, dead].all(1))]
        yield (
            f"DIVERGED: {dead.size} of {envs} envs are no longer finite, the first after {first:.3g} s: "
            f"{_list(dead)}. These gains are unstable on this robot."
        )
    alive = np.delete(metrics.settling_time, dead, axis=0)
    never = np.isinf(alive).sum(0) if len(alive) else np.zeros(robot.dof, int)
    unsettled = [f"{name} ({n})" for name, n in zip(robot.joint_names, never, strict=True) if n]
    if unsettled:
        yield (f"NOT SETTLED within {seconds:g} s to 2 % of the move, with the number of envs: {', '.join(unsettled)}.")
    if not dead.size and not unsettled:
        yield f"Every joint of every env settled within {seconds:g} s to 2 % of its move."
    yield from limit_notes(robot, rollout.setpoint[-1])


def limit_notes(robot: Robot, setpoint: NDArray[Any]) -> Iterator[str]:
    """Which setpoints (envs, dof) no joint can reach; one line says so if there are none."""
    worst: dict[int, float] = {}
    for _, index, value in robot.limit_violations(setpoint):
        joint = robot.joints[index]
        far = max(joint.lower - value, value - joint.upper)
        known = worst.get(index)
        if known is None or far > max(joint.lower - known, known - joint.upper):
            worst[index] = value
    for index, value in sorted(worst.items()):
        joint = robot.joints[index]
        yield (
            f"OUT OF LIMITS: setpoint {value:g} {joint.unit} of {joint.name}, whose limits are "
            f"[{joint.lower:g}, {joint.upper:g}]: that error cannot go."
        )
    if not worst:
        yield "Setpoints out of limits: none."


def _number(value: float) -> str:
    return "diverged" if math.isinf(value) else "-" if math.isnan(value) else f"{value:.2g}"


def _percent(share: float) -> str:
    return "diverged" if math.isinf(share) else "-" if math.isnan(share) else f"{share:.0%}"


def _seconds(value: float) -> str:
    return "never" if math.isinf(value) else "-" if math.isnan(value) else f"{value:.2f} s"


def _list(envs: NDArray[Any], most: int = 8) -> str:
    shown = ", ".join(map(str, envs[:most]))
    return f"env {shown}" + (f" and {len(envs) - most} more" if len(envs) > most else "")


def evaluation_table(robot: Robot, evaluations: list[Evaluation]) -> str:
    """One line per evaluation: the arm's joints over all moves, median and worst."""
    from sim.tuning.evaluation import arm_joints

    arm = arm_joints(robot)
    rows = []
    for evaluation in evaluations:
        m = evaluation.metrics
        settled = np.isfinite(m.settling_time[:, arm]).all(axis=1)
        in_time = (np.where(arm, m.settling_time, 0).max(1) <= evaluation.settling_limit).sum()
        columns = [
            _both(m.settling_time[:, arm], "{:.2f} s"),
            _both(m.overshoot[:, arm], "{:.1%}"),
            _both(m.steady_state_error[:, arm], "{:.1e}"),
            _both(evaluation.chatter[:, arm], "{:.1f}"),
            f"{settled.sum()} / {in_time} of {len(m.settling_time)}",
        ]
        diverged = int((~evaluation.rollout.ok.all(0)).sum())
        rows.append([evaluation.name, *columns, str(diverged) if diverged else "-"])
    headers = [
        "median / worst",
        "settling",
        "overshoot",
        "final error",
        "chatter",
        "settled / in time",
        "diverged",
    ]
    return table(rows, headers, "lrrrrrr") + (
        "\nOver the arm's joints and all moves. settled / in time: moves of which every joint settled, within the run"
        "\nand within a second or 1.2 times the shortest that the effort limits allow. chatter: variation of the effort"
        "\nover that of the smooth move."
    )


def _both(figure: Any, style: str) -> str:
    values = figure[~np.isnan(figure)]
    if not values.size:
        return "-"
    pair = (np.quantile(values, 0.5, method="higher"), values.max())
    return " / ".join("never" if np.isinf(value) else style.format(value) for value in pair)
