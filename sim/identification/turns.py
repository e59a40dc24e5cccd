"""Turns of revolute joints: positions and setpoints of a log that were logged modulo 2 pi become continuous."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.arrays.elementwise import TURN
from batchpid.sim.identification.columns import error
from batchpid.sim.identification.log import Log
from batchpid.sim.robot.robot import Robot

MOST_TURNS = 2
"""Most turns of a jump; positions that jump by more are not in rad."""
CLEAR = np.pi / 2
"""Largest change from row to row, apart from whole turns, at which the number of turns is certain [rad]."""


def unwrapped(robot: Robot, log: Log, row: Callable[[int], str]) -> tuple[Log, list[str]]:
    """Return ``log``, a stretch without gaps, with continuous positions, and the names of the joints that wrapped.

    Setpoints get the turns that bring them closest to the positions. ``row`` names a row of the log. Raises
    InvalidArgumentError if the number of turns is not certain.
    """
    qpos, command, wrapped = log.qpos.copy(), log.command.copy(), []
    for number, joint in enumerate(log.joints):
        name = robot.joint_names[joint]
        if robot.units[joint] != "rad":
            continue
        steps = np.diff(qpos[:, number])
        turns = np.rint(steps / TURN)
        if turns.any():
            _check(log, name, steps, turns, row)
            qpos[1:, number] -= TURN * np.cumsum(turns)
            wrapped.append(name)
        if log.kind == "setpoint" and (turns.any() or robot.continuous[joint]):
            measured = np.interp(log.command_time, log.time, qpos[:, number])
            command[:, number] = _closest(command[:, number], measured)
            far = np.abs(command[:, number] - measured) > np.pi
            if turns.any() and far.any():
                at = int(np.clip(np.searchsorted(log.time, log.command_time[np.argmax(far)]), 0, len(log.time) - 1))
                problem = (
                    f"{row(at)}: the setpoint of joint {name!r} is more than half a turn from its wrapped position"
                )
                raise error(log.source, problem, "unwrap the columns of the joint before they are logged")
    if np.array_equal(qpos, log.qpos) and np.array_equal(command, log.command):
        return log, []
    return replace(log, qpos=qpos, command=command), wrapped


def _check(log: Log, name: str, steps: Float64, turns: Float64, row: Callable[[int], str]) -> None:
    """Raise InvalidArgumentError if the ``turns`` of the ``steps`` of a joint from row to row are not certain."""
    unclear = np.flatnonzero((np.abs(steps - TURN * turns) > CLEAR) | (np.abs(turns) > MOST_TURNS))
    if not len(unclear):
        return
    at = int(unclear[0])
    problem = (
        f"{row(at + 1)}: joint {name!r} jumps by {steps[at]:.3g} rad within {log.time[at + 1] - log.time[at]:.3g} s"
    )
    if abs(turns[at]) > MOST_TURNS:
        raise error(log.source, problem, "give positions in rad")
    remedy = "the number of turns is not certain: log more rows per second, unwrap the column, or remove wrong rows"
    raise error(log.source, problem, remedy)


def _closest(setpoints: Float64, measured: Float64) -> Float64:
    """Return ``setpoints`` (commands,), wrapped or not, with the turns that bring them closest to ``measured``."""
    if np.abs(np.diff(setpoints)).max(initial=0.0) <= np.pi and np.abs(setpoints - measured).max() <= np.pi:
        return setpoints
    ways = [each - TURN * np.rint(np.median(each - measured) / TURN) for each in (setpoints, np.unwrap(setpoints))]
    return min(ways, key=lambda each: float(np.abs(each - measured).mean()))
