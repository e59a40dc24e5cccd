r"""Following errors on trajectories: ``python bench/trajectories.py [ROBOT ...] [--engine mujoco]`` (a minute a robot).

Twenty seeded moves without contact, as minimum-jerk motions at half the velocity limits (2 rad/s or 0.3 m/s where a
joint has none), in ticks of 10 ms: the largest and the median over the moves of max |qpos - setpoint| at the ticks'
ends, and the largest overshoot as a share of a joint's way of at least 0.05 rad or m. Moves in which an effort was
saturated are left out. With ``--sines``, amplitude and phase of a sine of 0.2 rad in every joint. The errors do not
depend on the machine's speed.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import tyro

from batchpid.sim import MovingSetpointWarning, Robot, Runner
from batchpid.sim.cli.report import table
from batchpid.sim.tuning.moves import FREE_VELOCITY, random_moves
from batchpid.trajectories import Trajectory, minimum_jerk

TICK, MOVES, SEED = 0.01, 20, 3


@dataclass(frozen=True)
class Trajectories:
    """Print the following errors of default gains, and of a drive, on smooth moves."""

    robots: Annotated[tuple[str, ...], tyro.conf.Positional] = ("panda", "jaco2")
    engine: str = "sapien"
    sines: bool = False

    def run(self) -> None:
        """Run the command."""
        warnings.simplefilter("ignore", MovingSetpointWarning)
        rows = []
        for name in self.robots:
            robot = Robot.load(name, missing_meshes="skip")
            rows += self._sines(robot) if self.sines else self._moves(robot)
        moved = ["robot", "gains", "given", "largest", "median", "overshoot"]
        swung = ["robot", "frequency", "given", "amplitude", "phase"]
        print(table(rows, swung if self.sines else moved, "lll" + "r" * (2 if self.sines else 3)))

    def _moves(self, robot: Robot) -> list[list[str]]:
        moves = random_moves(robot, MOVES, SEED)
        speed = np.minimum(robot.velocity_limit, 2 * np.array([FREE_VELOCITY[unit] for unit in robot.units]))
        move = minimum_jerk(moves.start, moves.target, TICK, max_velocity=0.5 * speed).hold(0.5)
        drive = robot.params(kp=200.0, ki=0.0, kd=20.0)
        sets: dict[str, dict[str, Any]] = {
            "tuned": {},
            "designed": {"params": robot.designed()},
            "designed, effort": {"params": robot.designed("effort")},
            "drive 200, 20": {"params": drive, "control": "drive"},
        }
        rows = []
        for gains, options in sets.items():
            for given in ("positions", "rates", "accelerations"):
                if given == "accelerations" and gains not in ("tuned", "designed"):
                    continue
                qpos, fine = self._follow(robot, moves.start, move, given, **options)
                off = (qpos - move.position)[..., robot.independent]
                turns = np.where(robot.continuous[robot.independent], np.round(off / (2 * np.pi)), 0.0)
                error = np.abs(off - 2 * np.pi * turns).max((0, 2))
                way = (moves.target - moves.start)[:, robot.independent]
                end = (off - 2 * np.pi * turns)[-round(0.5 / TICK) :] * np.sign(way)
                over = np.where(np.abs(way) > 0.05, end.max(0) / np.maximum(np.abs(way), 0.05), 0.0).max(1)
                figures = [
                    f"{error[fine].max():.4f}",
                    f"{np.median(error[fine]):.4f}",
                    f"{100 * over[fine].max():.1f} %",
                ]
                rows.append([robot.name, gains, given, *figures])
        return rows

    def _sines(self, robot: Robot) -> list[list[str]]:
        middle = robot.start if robot.settings is None else robot.target
        room = np.minimum(robot.upper - middle, middle - robot.lower)
        swings = (room > 0.25) & robot.independent & (np.array(robot.units) == "rad")
        time, rows = TICK * np.arange(1, 401), []
        grown = np.minimum(time, 1.0)
        window, slope = grown**3 * (10 - 15 * grown + 6 * grown**2), 30 * grown**2 * (1 - grown) ** 2
        for frequency in (0.5, 2.0):
            phase = 2 * np.pi * frequency * time
            wave = 0.2 * window * np.sin(phase)
            rate = 0.2 * (slope * np.sin(phase) + window * 2 * np.pi * frequency * np.cos(phase))
            position, velocity = (np.outer(x, swings)[:, None] for x in (wave, rate))
            move = Trajectory(time, middle + position, velocity, velocity)
            for given in ("positions", "rates"):
                qpos, _ = self._follow(robot, middle[None], move, given)
                late = time > 2
                basis = np.stack([np.sin(phase), np.cos(phase), np.ones_like(phase)], 1)[late]
                found = np.linalg.lstsq(basis, qpos[late, 0][:, swings], rcond=None)[0]
                amplitude, angle = np.hypot(*found[:2]) / 0.2, np.degrees(np.arctan2(found[1], found[0]))
                worst = int(np.abs(angle).argmax())
                share = amplitude[int(np.abs(amplitude - 1).argmax())]
                rows.append([robot.name, f"{frequency:g} Hz", given, f"{100 * share:.1f} %", f"{angle[worst]:.1f} deg"])
        return rows

    def _follow(self, robot: Robot, start: Any, move: Trajectory, given: str, **options: Any) -> tuple[Any, Any]:
        """Return the positions (ticks, envs, dof), and the envs without saturation or fault."""
        rates = {} if given == "positions" else {"setpoint_rates": move.velocity}
        rates |= {"setpoint_accelerations": move.acceleration} if given == "accelerations" else {}
        with Runner(robot, len(start), engine=self.engine, **options) as runner:
            runner.reset(start)
            rollout = runner.rollout(move.position, **rates)
        assert np.ptp(rollout.qpos, axis=0).max() > 0.01
        return rollout.qpos, rollout.ok.all(0) & ~rollout.saturated.any((0, 2))


if __name__ == "__main__":
    tyro.cli(Trajectories, description=__doc__).run()
