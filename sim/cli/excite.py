"""``batchpid excite``: a motion to record for ``batchpid identify``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np

from batchpid.arrays.field_tables import Field
from batchpid.sim import Robot
from batchpid.sim.cli import flags
from batchpid.sim.cli.outputs import FOLDER, OutputFiles


@dataclass(frozen=True)
class ExciteCommand:
    """Make the motion to record for identification: a chirp of every joint.

    It keeps the limits of position, velocity and effort, and is free of contact. Writes setpoints
    and their rates as CSV with the header "time, setpoint:JOINT, ..., setpoint_rate:JOINT, ...",
    which `batchpid rollout --trajectory` follows. Move the robot to the first row before it starts,
    and add the measured positions to the log as qpos:JOINT.
    """

    robot: flags.RobotName = "panda"
    seconds: Annotated[float, Field("s", low=1.0, high=3600.0)] = 10.0
    """Duration of the motion [s]."""
    rate: Annotated[float, Field("Hz", low=20.0, high=10_000.0)] = 500.0
    """Rows per second [Hz]."""
    lowest: Annotated[float, Field("Hz", low=0.01, high=50.0)] = 0.15
    """Lowest frequency of the chirp [Hz]."""
    highest: Annotated[float, Field("Hz", low=0.01, high=1000.0)] = 3.0
    """Highest frequency [Hz]."""
    seed: flags.Seed = 0
    """Seed of the phases."""
    meshes: flags.Meshes = field(default_factory=flags.MeshOptions)
    out: flags.OptionalPath = None
    """File to write: .csv. Default: out/ROBOT.excite.csv."""
    force: flags.Force = False

    imports = ("batchpid.sim.robot.robot_model", "batchpid.sim.identification.excitation")

    def run(self) -> None:
        """Run the command."""
        from batchpid.io.files import write_atomically
        from batchpid.sim.cli.report import table
        from batchpid.sim.identification.excitation import excite
        from batchpid.sim.recording.setpoint_files import setpoint_csv

        out = self.out or FOLDER / f"{Path(self.robot).stem}.excite.csv"
        out = OutputFiles(self).path("out", out, (".csv",))
        robot = Robot.load(self.robot, **vars(self.meshes))
        motion = excite(
            robot,
            self.seconds,
            rate=self.rate,
            lowest=self.lowest,
            highest=self.highest,
            seed=self.seed,
        )
        out.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(out, setpoint_csv(robot, motion))
        rows = [
            [name, f"{low:.3f} to {high:.3f} {unit}", f"{speed:.3g} {unit}/s"]
            for name, unit, low, high, speed in zip(
                robot.joint_names,
                robot.units,
                motion.position.min(0),
                motion.position.max(0),
                abs(motion.velocity).max(0),
                strict=True,
            )
        ]
        print(table(rows, ["joint", "moves from ... to", "fastest"], "lrr"))
        if still := [
            name
            for name, span in zip(robot.joint_names, np.ptp(motion.position, axis=0), strict=True)
            if not span
        ]:
            print(
                "\nToo weak for their friction and gravity, so they stay still:"
                f" {', '.join(still)}."
            )
        print(
            f"\nwritten: {out}: {motion.ticks} rows of {motion.time[0]:g} s; the robot starts at"
            " rest at the first row"
        )
