"""Follow a trajectory: to the tutorial's pose and back along a step and minimum jerk.

    python examples/follow_trajectory.py

Each robot of the batch follows another profile over the same path, under the default gains. The
runner gets rates and accelerations of the setpoint: the errors that remain show how hard a profile
is to follow.
"""

import numpy as np

from batchpid.sim import Robot, Runner
from batchpid.trajectories import Trajectory, minimum_jerk

DT = 0.01  # a tick: 20 sim steps [s]


def profiles(start, target, velocity) -> dict[str, Trajectory]:
    """Return the same move at two speeds and as a step, held at the end for 1 s or longer."""
    moves = {
        name: minimum_jerk(start, target, DT, max_velocity=share * velocity, hold=hold)
        for name, share, hold in (("minimum jerk", 1.0, 3.0), ("half as fast", 0.5, 1.0))
    }
    moves["step"] = minimum_jerk(target, target, DT, duration=DT, hold=5.0)
    return moves


def main():
    """Run one robot per profile and print the errors of each."""
    robot = Robot.load("panda")
    moves = profiles(robot.start, robot.target, 0.5 * robot.velocity_limit)
    ticks = min(move.ticks for move in moves.values())
    position, rate, acceleration = (
        np.stack([getattr(move, name)[:ticks] for move in moves.values()], axis=1)
        for name in ("position", "velocity", "acceleration")
    )
    with Runner(robot, len(moves)) as runner:
        rollout = runner.rollout(position, setpoint_rates=rate, setpoint_accelerations=acceleration)
    arm = slice(0, 7)
    error = np.abs(rollout.qpos - rollout.setpoint)[:, :, arm]
    print(
        f"{'profile':14} {'arrives':>9} {'worst error':>12} {'final error':>12} {'peak effort':>12}"
    )
    for env, (name, move) in enumerate(moves.items()):
        arrival = move.time[np.argmax((move.position == move.position[-1]).all(-1))]
        print(
            f"{name:14} {arrival:7.2f} s {1e3 * error[:, env].max():7.2f} mrad"
            f" {1e3 * error[-1, env].max():7.3f} mrad"
            f" {np.abs(rollout.effort[:, env, arm]).max():8.1f} N m"
        )


if __name__ == "__main__":
    main()
