"""Log of a robot in motion."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np

import batchpid as bp
from batchpid.arrays.array_types import Float64, Rows
from batchpid.sim.robot.robot import Robot

CommandKind = Literal["setpoint", "effort"]
Sensor = Literal["motor", "link"]
"""Place at which an effort is measured: at the motor, as by its current, or behind the gear."""


class LogWarning(UserWarning):
    """A log shows an effect that the model of the robot lacks, or has stretches that are too short."""


class LogSettings(NamedTuple):
    """Settings of one log among several; None: as all."""

    robot: Robot | None = None
    """The robot, with the same joints as all."""
    params: bp.PIDParams | None = None
    """Params of the PID law, of the joints of the log."""
    payload: float = 0.0
    """Known payload at the tool [kg], in addition to one that is found."""
    held_out: bool | None = None
    """True to hold out the whole log, False to fit it all; None: its last quarter is held out."""


ALIKE = LogSettings()
"""Settings of a log that has none of its own."""


@dataclass(frozen=True, eq=False)
class Log:
    """Commands and measured positions of some joints of one robot."""

    source: str
    """Name of its file, and the env of a recording."""
    joints: tuple[int, ...]
    """Numbers of its joints, in the robot's order; followers are left out."""
    kind: CommandKind
    time: Float64
    """Times of the measurements (rows,) [s], increasing."""
    qpos: Float64
    """Measured positions (rows, joints) [rad or m]."""
    command_time: Float64
    """Times from which the commands act (commands,) [s]."""
    command: Float64
    """Setpoints [rad or m] or efforts [N m or N] (commands, joints)."""
    held: bool
    """True if a command holds until the next one; False to interpolate between them."""
    qvel: Float64 | None = None
    """Measured velocities (rows, joints), if there are any."""
    timestep: float | None = None
    """Time step of the control [s], where the log says it."""
    compensate: str | None = None
    """Forces that the robot compensated, where the log says it."""
    feedforward: Float64 | None = None
    """Efforts that are added to the efforts of the law (commands, joints) [N m or N]."""
    measured: Float64 | None = None
    """Measured efforts beside the commands (rows, joints) [N m or N]."""
    sensor: Sensor | None = None
    """Place at which ``measured``, or else ``command``, was measured; None: nothing was."""
    settings: LogSettings = ALIKE

    @property
    def seconds(self) -> float:
        """Length [s]."""
        return float(self.time[-1] - self.time[0])

    @property
    def is_measured(self) -> bool:
        """True if the efforts of ``command`` are not commanded but measured."""
        return self.sensor is not None and self.measured is None

    def part(self, rows: Any = slice(None), commands: Any = slice(None), joints: Any = slice(None)) -> Log:
        """Return the log of some rows, commands and joints: slices, or a mask of joints."""

        def cut(table: Float64 | None, kept: Any) -> Any:
            return None if table is None else table[kept][:, joints]

        return replace(
            self,
            joints=tuple(np.array(self.joints)[joints].tolist()),
            time=self.time[rows],
            command_time=self.command_time[commands],
            **{name: cut(getattr(self, name), rows) for name in ("qpos", "qvel", "measured")},
            **{name: cut(getattr(self, name), commands) for name in ("command", "feedforward")},
        )

    def commands_at(self, time: Float64, table: Float64 | None = None) -> Float64:
        """Return the commands that act at ``time`` (n,), as (n, joints); the first one also acts before its time.

        ``table`` takes the place of the commands, such as the feedforward.
        """
        table = self.command if table is None else table
        if self.held:
            index = np.searchsorted(self.command_time, time + 1e-9, side="right") - 1
            return table[np.clip(index, 0, len(table) - 1)]
        return interpolated(time, self.command_time, table)


def interpolated(time: Float64, known: Rows, table: Rows) -> Float64:
    """Return the rows (n, columns) at ``time`` (n,) of a table whose rows are for the times ``known``."""
    return np.stack([np.interp(time, known, column) for column in table.T], axis=1)
