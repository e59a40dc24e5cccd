"""Sets of gains by name: what ``compare`` tries, and ``tune`` tries before and after."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from sim import Robot

NAMES = ("tutorial", "tuned", "designed", "drive")


class GainSet(NamedTuple):
    """A name, and the options of :func:`sim.tuning.evaluation.evaluate_gains` that stand for it."""

    name: str
    options: dict[str, Any]


def gain_set(robot: Robot, name: str) -> GainSet:
    """Gains by name: "tutorial", "tuned", "designed", "drive", "drive:STIFFNESS,DAMPING", or a params file.

    Raises
    ------
    InvalidArgumentError
        No such name or file, or the robot carries no gains of that name.
    """
    from batchpid import load_params
    from batchpid.errors import InvalidArgumentError
    from sim.tuning.search import start_gains

    if name == "tutorial":
        return GainSet(name, {"params": robot.params()})
    if name == "tuned":
        return GainSet(name, {"params": robot.tuned()})
    if name == "designed":
        return GainSet(name, {"params": start_gains(robot)})
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
    return GainSet(path.name, {"params": params})
