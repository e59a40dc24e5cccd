"""Sets of gains by name: what ``compare`` tries, and ``tune`` tries before and after."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from batchpid.cli import report

if TYPE_CHECKING:
    from sim import Robot
    from sim.trial import Trial

NAMES = ("tutorial", "tuned", "designed", "drive")


class GainSet(NamedTuple):
    """A name, and the options of :func:`sim.trial.try_gains` that stand for it."""

    name: str
    options: dict[str, Any]


def gain_set(robot: Robot, name: str) -> GainSet:
    """Gains by name: "tutorial", "tuned", "designed", "drive", "drive:STIFFNESS,DAMPING", or a params file.

    Raises
    ------
    InvalidArgumentError
        No such name or file, or the robot carries no gains of that name.
    """
    from batchpid import load_about, load_params
    from batchpid.errors import InvalidArgumentError
    from sim.tune import start_gains

    if name == "tutorial":
        return GainSet(name, {"params": robot.params()})
    if name == "tuned":
        return GainSet(name, robot.tuned())
    if name == "designed":
        return GainSet(name, {"params": start_gains(robot), "measurement_rate": True})
    if name.partition(":")[0] == "drive":
        try:
            stiffness, damping = (float(part) for part in (name.partition(":")[2] or "20,5").split(","))
        except ValueError:
            raise InvalidArgumentError(
                "gains", "is no drive", value=name, remedy="write drive:STIFFNESS,DAMPING, e.g. drive:20,5"
            ) from None
        params = robot.params(kp=stiffness, ki=0.0, kd=damping, effort_limit=None)
        return GainSet(f"drive ({stiffness:g}, {damping:g})", {"params": params, "control": "drive"})
    path = Path(name)
    if not path.is_file():
        raise InvalidArgumentError(
            "gains", "is neither a name nor a file", value=name, remedy=f"use a file or {', '.join(NAMES)}"
        )
    params, _ = load_params(path, robot.joint_names)
    told = load_about(path).get("measurement_rate", False)
    return GainSet(path.name, {"params": params, "measurement_rate": bool(told)})


def trial_table(robot: Robot, trials: list[Trial]) -> str:
    """One line per trial: the arm's joints over all moves, median and worst."""
    from sim.trial import arm_joints

    arm = arm_joints(robot)
    rows = []
    for trial in trials:
        m = trial.metrics
        settled = np.isfinite(m.settling_time[:, arm]).all(axis=1)
        in_time = (np.where(arm, m.settling_time, 0).max(1) <= trial.allowed).sum()
        columns = [
            _both(m.settling_time[:, arm], "{:.2f} s"),
            _both(m.overshoot[:, arm], "{:.1%}"),
            _both(m.steady_state_error[:, arm], "{:.1e}"),
            _both(trial.chatter[:, arm], "{:.1f}"),
            f"{settled.sum()} / {in_time} of {len(m.settling_time)}",
        ]
        diverged = int((~trial.rollout.ok.all(0)).sum())
        rows.append([trial.name, *columns, str(diverged) if diverged else "-"])
    headers = [
        "median / worst",
        "settling",
        "overshoot",
        "final error",
        "chatter",
        "settled / in time",
        "diverged",
    ]
    return report.table(rows, headers, "lrrrrrr") + (
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
