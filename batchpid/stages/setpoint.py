"""Setpoint at a moment of the tick."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

from batchpid.stages.control import Control
from batchpid.stages.stage import Stage
from batchpid.stages.values import Told, Values


@dataclass(frozen=True)
class Setpoint(Stage):
    """The setpoint at the time ``left`` before the end of its tick, where its rate is given::

        r <- r - left (r' - left r'' / 2)        r' <- r' - left r''

    A setpoint and its rate hold at the end of their tick, as in
    :class:`batchpid.trajectories.Trajectory`; an acceleration is the same in the whole tick.
    """

    name = "setpoint"

    @classmethod
    def of(cls, control: Control) -> Self:
        return cls()

    def step(self, state: tuple[()], values: Values) -> Told:
        setpoint, rate, acceleration, _ = values.command
        if rate is None:
            return state, values
        left = values.step.left
        change = left * acceleration
        command = values.command._replace(
            setpoint=setpoint - left * (rate - 0.5 * change), setpoint_rate=rate - change
        )
        return state, values._replace(command=command)
