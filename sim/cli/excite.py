"""``batchpid excite``: a motion to record for ``batchpid identify``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np

from batchpid.arrays.field_tables import Field
from batchpid.io.files import write_atomically
from batchpid.sim import Robot
from batchpid.sim.cli.flags import flag
from batchpid.sim.diagnosis.text import table
from batchpid.trajectories import Trajectory


class Excitation(NamedTuple):
    """Motion that excites the joints of a robot."""

    robot: Robot
    motion: Trajectory

    def report(self) -> str:
        """Return the range and the largest speed of each joint."""
        names = self.robot.joint_names
        units = self.robot.units
        low = self.motion.position.min(0)
        high = self.motion.position.max(0)
        speed = np.abs(self.motion.velocity).max(0)
        rows = []
        still = []
        for joint, (name, unit) in enumerate(zip(names, units, strict=True)):
            span = f"{low[joint]:.3f} to {high[joint]:.3f} {unit}"
            rows.append([name, span, f"{speed[joint]:.3g} {unit}/s"])
            if low[joint] == high[joint]:
                still.append(name)
        lines = [table(rows, ["joint", "moves from ... to", "fastest"], "lrr")]
        if still:
            lines.append(
                f"\nToo weak for their friction and gravity, so they stay still: {', '.join(still)}."
            )
        lines.append(
            f"\n{self.motion.ticks} rows of {self.motion.time[0]:g} s; the robot starts at rest at"
            " the first row"
        )
        return "\n".join(lines)

    def save(self, path: Path) -> None:
        """Write the setpoints and their rates as CSV."""
        from batchpid.sim.recording.setpoint_files import setpoint_csv

        write_atomically(path, setpoint_csv(self.robot, self.motion))


def excite_joints(
    robot: Robot,
    seconds: Annotated[
        float, Field("s", low=1.0, high=3600.0), flag("Duration of the motion [s].")
    ] = 10.0,
) -> Excitation:
    """Make the motion to record for identification: a chirp of every joint.

    It keeps the limits of position, velocity and effort, and is free of contact. Writes setpoints
    and their rates as CSV with the header "time, setpoint:JOINT, ..., setpoint_rate:JOINT, ...",
    which `batchpid rollout --trajectory` follows. Move the robot to the first row before it starts,
    and add the measured positions to the log as qpos:JOINT.
    """
    from batchpid.sim.identification.excitation import excite

    return Excitation(robot, excite(robot, seconds))
