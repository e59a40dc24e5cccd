"""Time the closed loop over several motions: the tutorial's, holding the start pose, and seeded moves.

    python bench/motions.py [--json FILE]

The speed depends on the motion: if shapes are near each other, as in a closed gripper, the engine is slower. Everything
runs in this process, in interleaved rounds: the tutorial's loop, and the closed loop. Times are processor times, which
another program disturbs less.
"""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tyro
from tutorial import TutorialLoop

from batchpid.io.files import write_atomically
from batchpid.sim import Robot, Runner
from batchpid.sim.engine import native
from batchpid.sim.tuning.moves import Moves, random_moves, tutorial_move

SUBSTEPS = 20
REPEATS = 4
"""Runs of the tutorial's loop in a round: one robot alone is soon done."""
HOLD = "start pose held"
VARIANTS: dict[str, dict[str, Any]] = {
    "accurate": {"physics": "accurate"},
    "fast": {"physics": "fast"},
    "no shapes": {"physics": "fast", "collisions": False},
}
"""Options of the runner; the moves touch nothing."""


def motions(robot: Robot, count: int) -> Moves:
    """Return the motions, by name."""
    hold = Moves(robot.start[None], robot.start[None], (HOLD,))
    drawn = random_moves(robot, count, seed=0)
    return tutorial_move(robot) + hold + drawn._replace(names=tuple(f"move {number}" for number in range(count)))


@dataclass(frozen=True)
class Options:
    """Time the closed loop over several motions.

    Prints the distance that a joint moved [rad or m], the time of an env step [us], and the speed relative to the
    tutorial's loop, per process.
    """

    robots: tuple[str, ...] = ("panda", "jaco2")
    num_envs: int = 32
    moves: int = 20
    ticks: int = 50
    rounds: int = 3
    json: Path | None = None
    """File for the figures."""


def main(options: Options) -> None:
    """Print the table and write the figures."""
    print(native.obstacle() or "native code")
    print(f"\n| robot, solver, motion | moved | us | tutorial's loop |\n{'| --- ' * 4}|")
    figures: dict[str, dict[str, dict[str, float]]] = {}
    for name in options.robots:
        robot = Robot.load(name, dissipation="sapien")
        chosen = motions(robot, options.moves)
        tutorials = [TutorialLoop(robot, target, start=start) for start, target in zip(*chosen[:2], strict=True)]
        for variant, ours in VARIANTS.items():
            rows = [*measure(robot, chosen, tutorials, ours, options)]
            for motion, row in zip(chosen.names, rows, strict=True):
                cells = f"{name}, {variant}, {motion}", f"{row.moved:.2g}", f"{row.us:.1f}", f"{row.over:.2f}"
                print(f"| {' | '.join(cells)} |", flush=True)
            over = [row.over for row in rows]
            found = dict(zip(chosen.names[:2], over, strict=False))
            found |= {"median": statistics.median(over), "slowest": min(over)}
            for case in ("median", "slowest"):
                print(f"| **{name}, {variant}, {case}** | | | **{found[case]:.2f}** |")
            figures.setdefault(name, {})[variant] = {motion: round(ratio, 2) for motion, ratio in found.items()}
    if options.json is not None:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(options.json, json.dumps({"motions": figures, "moves": options.moves}) + "\n")


class Row(NamedTuple):
    """Figures of one motion."""

    moved: float
    us: float
    over: float
    """Speed relative to the tutorial's loop, both in one process."""


def measure(
    robot: Robot, chosen: Moves, tutorials: list[TutorialLoop], ours: dict[str, Any], options: Options
) -> Iterator[Row]:
    """Yield the figures of each of the motions, with its tutorial's loop, under the options ``ours`` of the runner."""
    size = options.num_envs
    with Runner(robot, size, params=robot.params(), workers=0, **ours) as runner:
        for start, target, motion, tutorial in zip(*chosen, tutorials, strict=True):
            times: list[tuple[float, float]] = []
            for _ in range(options.rounds):
                began = time.process_time()
                for _ in range(REPEATS):
                    tutorial.reset()
                    tutorial.run(options.ticks * SUBSTEPS)
                theirs = size / REPEATS * (time.process_time() - began)
                runner.reset(start)
                began = time.process_time()
                qpos = runner.rollout(np.broadcast_to(target, (options.ticks, robot.dof))).qpos
                times.append((theirs, time.process_time() - began))
                moved = float(np.abs(qpos[-1] - start).max())
                # Friction holds some short moves: they are timed, too, and the table tells.
                if motion in (HOLD, "tutorial"):
                    assert (moved > 0.01) == (motion != HOLD), f"{motion}: the robots moved by {moved:g} rad"
            us = statistics.median(each for _, each in times) / (size * options.ticks * SUBSTEPS) * 1e6
            yield Row(moved, us, statistics.median(theirs / each for theirs, each in times))


if __name__ == "__main__":
    main(tyro.cli(Options))
