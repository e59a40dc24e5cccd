"""Drive N robots to the tutorial's pose: with PhysX's internal drive, with the batch PID, or not at
all.

    python examples/drive_robot.py --use-external-pid
    python examples/drive_robot.py --use-internal-drive --compensate none
    python examples/drive_robot.py --use-external-pid --compensate none --seconds 6
    python examples/drive_robot.py panda                                    # undriven: it falls

SAPIEN's tutorial "Drive Robot with PID Controller" has the same two switches. Without compensation
a drive keeps a steady-state error, because its effort against gravity is proportional to the error;
the integral of a PID removes it. The tutorial's own gains (--gains tutorial) oscillate, because the
robot is as frictionless as its URDF says.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import tyro

from batchpid.sim import Robot, Runner


@dataclass(frozen=True)
class Options:
    """Options of the run."""

    robot: tyro.conf.Positional[Literal["jaco2", "panda"]] = "jaco2"
    """Bundled robot."""
    use_internal_drive: bool = False
    """PhysX's PD drive, stiffness 20 and damping 5."""
    use_external_pid: bool = False
    """Batch PID, computed at every sim step."""
    gains: Literal["tuned", "tutorial"] = "tuned"
    """Gains of the PID: those that batchpid tune found, or the tutorial's."""
    compensate: Literal["gravity+coriolis", "gravity", "none"] | None = None
    """Passive force added to the joints. Default: gravity+coriolis where they are driven, else
    none.
    """
    num_envs: int = 8
    """Number of robots, each from a slightly different pose."""
    seconds: float = 3.0
    """Simulated time [s]."""


def main(options: Options) -> None:
    """Run the robots, then print the final position of each joint of the first one."""
    if options.use_internal_drive and options.use_external_pid:
        raise SystemExit(
            "the internal drive and the PID would add up: choose one of the two switches"
        )
    driven = options.use_internal_drive or options.use_external_pid
    control = (
        "drive" if options.use_internal_drive else "pid" if options.use_external_pid else "effort"
    )
    compensate = options.compensate or ("gravity+coriolis" if driven else "none")

    robot = Robot.load(options.robot)
    target = robot.target
    command = (
        target if driven else np.zeros(robot.dof)
    )  # under "effort" it is the joint effort itself
    params = None  # the drive's stiffness and damping are the robot's
    if control == "pid":
        params = robot.tuned() if options.gains == "tuned" else robot.params()
    start = robot.start + np.random.default_rng(0).uniform(-0.1, 0.1, (options.num_envs, robot.dof))
    start = np.clip(start, robot.lower, robot.upper)

    with Runner(
        robot,
        options.num_envs,
        engine="sapien",
        control=control,
        compensate=compensate,
        params=params,
    ) as runner:
        runner.reset(start)
        ticks = round(options.seconds / (runner.substeps * runner.timestep))
        rollout = runner.rollout(np.broadcast_to(command, (ticks, robot.dof)))

    error = np.abs(rollout.qpos[-1] - target)
    print(
        f"{options.num_envs} x {robot.name}, {control=}, {compensate=}, after"
        f" {rollout.time[-1]:g} s"
    )
    print(f"{'joint':30} {'start':>8} {'target':>8} {'end':>8} {'error':>9} {'worst env':>10}")
    for j, joint in enumerate(robot.joints):
        print(
            f"{joint.name:30} {start[0, j]:8.3f} {target[j]:8.3f} {rollout.qpos[-1, 0, j]:8.3f} "
            f"{error[0, j]:9.5f} {error[:, j].max():10.5f} {joint.unit}"
        )


if __name__ == "__main__":
    main(tyro.cli(Options))
