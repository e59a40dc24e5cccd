"""Time the closed loop over several motions: the tutorial's, holding the start pose, and seeded moves.

    python bench/motions.py

The speed depends on the motion: the engine steps shapes that are near each other slower, such as those of a closed
gripper, and the loop has to look at their contacts. Everything runs in this process, in interleaved rounds: the
tutorial's loop, the closed loop, and the closed loop without isolation of robots that are about to be touched
(:mod:`sim.engine.contact_prediction`), which shows what the isolation costs.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import tyro

from sim import Robot, Runner
from sim.benchmark.tutorial import TutorialLoop
from sim.engine.native import status
from sim.engine.pack import Pack
from sim.tuning.moves import Moves, random_moves, tutorial_move

NUM_ENVS, SUBSTEPS = 32, 20
HOLD = "start pose held"
CASES = "tutorial's loop", "isolating", "not isolating"


@contextmanager
def isolation(enabled: bool) -> Iterator[None]:
    """Build packs whose robots move to a system to themselves before something touches them, or do not."""
    init = Pack.__init__

    def without(pack: Pack, *arguments: object) -> None:
        init(pack, *arguments, isolates=False)  # type: ignore[arg-type, misc]

    if not enabled:
        Pack.__init__ = without  # type: ignore[assignment, method-assign]
    try:
        yield
    finally:
        Pack.__init__ = init  # type: ignore[method-assign]


def motions(robot: Robot, count: int) -> Moves:
    """Return the motions, by name."""
    hold = Moves(robot.start[None], robot.start[None], (HOLD,))
    drawn = random_moves(robot, count, seed=0)
    return tutorial_move(robot) + hold + drawn._replace(names=tuple(f"move {number}" for number in range(count)))


def main(robots: tuple[str, ...] = ("panda", "jaco2"), moves: int = 20, ticks: int = 50, rounds: int = 3) -> None:
    """Print what a joint moved by, an env step's time, the speed over the tutorial's loop, and what isolation costs.

    In rad or m, microseconds, and the ratio to the time without isolation.
    """
    print(f"{status()}\n\n| robot, solver, motion | moved | us | tutorial's loop | isolation |\n{'| --- ' * 5}|")
    for name in robots:
        robot = Robot.load(name, dissipation="sapien")
        chosen = motions(robot, moves)
        for physics in ("accurate", "fast"):
            runners = {}
            for case, enabled in zip(CASES[1:], (True, False), strict=True):
                with isolation(enabled):
                    runners[case] = Runner(robot, NUM_ENVS, params=robot.params(), workers=0, physics=physics)
            over, costs = [], []
            for start, target, motion in zip(*chosen, strict=True):
                seconds: dict[str, list[float]] = {case: [] for case in CASES}
                tutorial = TutorialLoop(robot, target, start=start)
                for _ in range(rounds):
                    tutorial.reset()
                    began = time.perf_counter()
                    tutorial.run(ticks * SUBSTEPS)
                    seconds[CASES[0]].append(NUM_ENVS * (time.perf_counter() - began))
                    for case, runner in runners.items():
                        runner.reset(start)
                        began = time.perf_counter()
                        qpos = runner.rollout(np.broadcast_to(target, (ticks, robot.dof))).qpos
                        seconds[case].append(time.perf_counter() - began)
                        moved = np.abs(qpos[-1] - start).max()
                        # Friction holds some short moves: they are timed, too, and the table tells.
                        if motion in (HOLD, "tutorial"):
                            assert (moved > 0.01) == (motion != HOLD), f"{motion}: the robots moved by {moved:g} rad"
                paired = list(zip(*seconds.values(), strict=True))
                over.append(statistics.median(first / loop for first, loop, _ in paired))
                costs.append(statistics.median(loop / off for _, loop, off in paired))
                us = statistics.median(seconds[CASES[1]]) / (NUM_ENVS * ticks * SUBSTEPS) * 1e6
                row = f"{name}, {physics}, {motion}", f"{moved:.2g}", f"{us:.1f}", f"{over[-1]:.2f}", f"{costs[-1]:.3f}"
                print(f"| {' | '.join(row)} |", flush=True)
            for case, pick in (("median", statistics.median), ("slowest", min)):
                print(f"| **{name}, {physics}, {case}** | | | **{pick(over):.2f}** | {statistics.median(costs):.3f} |")
            for runner in runners.values():
                runner.close()


if __name__ == "__main__":
    tyro.cli(main)
