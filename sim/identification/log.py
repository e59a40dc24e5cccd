"""Log of a robot in motion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from batchpid.arrays.array_types import Float64

CommandKind = Literal["setpoint", "effort"]


class LogWarning(UserWarning):
    """A log shows an effect that the model of the robot lacks, or has stretches that are too short."""


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

    @property
    def seconds(self) -> float:
        """Length [s]."""
        return float(self.time[-1] - self.time[0])

    def commands_at(self, time: Float64) -> Float64:
        """Return the commands that act at ``time`` (n,), as (n, joints); the first one also acts before its time."""
        if self.held:
            index = np.searchsorted(self.command_time, time + 1e-9, side="right") - 1
            return self.command[np.clip(index, 0, len(self.command) - 1)]
        columns = [np.interp(time, self.command_time, column) for column in self.command.T]
        return np.stack(columns, axis=1)
