"""Follow a trajectory: to the tutorial's pose and back along a step, a trapezoid, minimum jerk, or limited jerk.

    python examples/follow_trajectory.py

Each robot of the batch follows another profile over the same path, under a PD with gains in efforts and under the tuned
gains, which are per mass matrix. Both get the setpoint's rate, so that they damp the velocity error and not the
velocity. What remains of the PD's error is due to the acceleration: gains per mass matrix take it from the rates.
"""

import numpy as np

from batchpid.errors import MissingDependencyError
from batchpid.sim import Robot, Runner
from batchpid.trajectories import Trajectory, jerk_limited, minimum_jerk, trapezoidal

DT = 0.01  # a tick: 20 sim steps [s]
# Stiffness and damping of the arm in libfranka's joint impedance example, and a soft hold of the fingers.
KP = [600, 600, 600, 600, 250, 150, 50, 100, 100]  # N m/rad, N/m
KD = [50, 50, 50, 50, 30, 25, 15, 10, 10]  # N m s/rad, N s/m


def profiles(start, target, velocity, acceleration) -> dict[str, Trajectory]:
    """Return the same move as four profiles, held at the end for 1 s or longer."""
    limits = {"max_velocity": velocity, "max_acceleration": acceleration}
    moves = {"trapezoidal": trapezoidal(start, target, DT, **limits)}
    try:
        moves["jerk limited"] = jerk_limited(start, target, DT, **limits, max_jerk=10 * acceleration)
    except MissingDependencyError as error:
        print(error)
    moves["minimum jerk"] = minimum_jerk(start, target, DT, **limits)
    last = max(move.time[-1] for move in moves.values())
    still = np.broadcast_to(target, (1, len(target)))
    moves["step"] = Trajectory(np.array([DT]), still, 0 * still, 0 * still)
    return {name: move.hold(last + 1.0 - move.time[-1]) for name, move in moves.items()}


def main():
    """Run one robot per profile under each set of gains, and print the errors."""
    robot = Robot.load("panda")
    velocity = 0.5 * robot.velocity_limit
    moves = profiles(robot.start, robot.settings.target, velocity, acceleration=4 * velocity)
    ticks = min(move.ticks for move in moves.values())
    position, rate = (
        np.stack([getattr(move, name)[:ticks] for move in moves.values()], axis=1) for name in ("position", "velocity")
    )
    sets = {"PD": robot.params(kp=KP, ki=0.0, kd=KD, derivative_filter_time=0.002), "tuned": robot.tuned()}
    arrivals = [move.time[np.argmax((move.position == move.position[-1]).all(-1))] for move in moves.values()]
    rows = [f"{name:16}{arrival:8.2f} s" for name, arrival in zip(moves, arrivals, strict=True)]
    for params in sets.values():
        with Runner(robot, len(moves), params=params) as runner:
            rollout = runner.rollout(position, setpoint_rates=rate)
        errors = np.abs(rollout.qpos - rollout.setpoint)[:, :, :7].max((0, 2))  # of the arm
        efforts = np.abs(rollout.effort)[:, :, :7].max((0, 2))
        pairs = zip(rows, errors, efforts, strict=True)
        rows = [f"{row}{error:10.4f} rad{effort:8.1f} N m" for row, error, effort in pairs]
    print(f"{'':26}" + "".join(f"{name:>26}" for name in sets))
    print(f"{'profile':16}{'arrives':>10}" + 2 * f"{'worst error':>14}{'effort':>12}")
    print("\n".join(rows))


if __name__ == "__main__":
    main()
