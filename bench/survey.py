"""How far many robots get: each is loaded, built and moved under designed gains, in a separate
process.

``python bench/survey.py PATH ... [--engine mujoco] [--moves 8]`` prints a table in Markdown of
robots' files, and of all *.urdf in folders. A move has settled if every joint stays within 2 % of
it and ends within 1e-3 rad (or m) of the setpoint. A robot that crashes the engine, or takes more
than 300 s, ends only its own process.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from tabulate import tabulate

from batchpid.errors import BatchPIDError
from batchpid.sim import Robot
from batchpid.sim.tuning.evaluation import evaluate_gains
from batchpid.sim.tuning.moves import random_moves

HEADERS = (
    "robot",
    "joints",
    "settled",
    "largest error",
    "overshoot",
    "findings, or what went wrong",
)
SECONDS, LIMIT = 2.0, 300.0
"""Simulated time of a move, and wall-clock time of a robot [s]."""


def survey(path: Path, engine: str, count: int) -> list[str]:
    """Return the row of one robot."""
    row = [path.name, *["-"] * 4]
    try:
        robot = Robot.load(path)
        row[1] = str(robot.dof)
        params = robot.designed()
        codes = {finding.code for finding in robot.check(params=params)}
        moves = random_moves(robot, count)
        result = evaluate_gains(robot, params, moves, seconds=SECONDS, engine=engine, workers=0)
    except BatchPIDError as error:
        return [*row, " ".join(str(error).split())]
    metrics = result.metrics
    ends = np.nan_to_num(metrics.settling_time, nan=0.0) < np.inf
    settled = (ends & (metrics.steady_state_error <= 1e-3)).all(1).sum()
    row[2:] = f"{settled} of {count}", f"{metrics.steady_state_error.max():.0e}"
    return [*row, f"{np.nan_to_num(metrics.overshoot).max():.0%}", ", ".join(sorted(codes))]


def main() -> None:
    """Survey the robots of the command line, two at once."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("paths", nargs="+", type=Path)
    parser.add_argument("--engine", default="mujoco", choices=["sapien", "mujoco"])
    parser.add_argument("--moves", default=8, type=int)
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        warnings.simplefilter("ignore")
        print(json.dumps(survey(options.paths[0], options.engine, options.moves)))
        return
    files = list[Path]()
    for path in options.paths:
        files += sorted(path.rglob("*.urdf")) if path.is_dir() else [path]

    def run(path: Path) -> list[str]:
        words = [
            sys.executable,
            __file__,
            str(path),
            "--one",
            "--engine",
            options.engine,
            "--moves",
            str(options.moves),
        ]
        try:
            done = subprocess.run(words, capture_output=True, text=True, timeout=LIMIT)
        except subprocess.TimeoutExpired:
            return [path.name, *["-"] * 4, f"takes more than {LIMIT:g} s"]
        if done.returncode:
            return [
                path.name,
                *["-"] * 4,
                f"the process ended with status {done.returncode}: {done.stderr[-200:]}",
            ]
        row: list[str] = json.loads(done.stdout.splitlines()[-1])
        return row

    with ThreadPoolExecutor(2) as pool:
        rows = list(pool.map(run, files))
    print(tabulate(rows, HEADERS, tablefmt="github", disable_numparse=True))


if __name__ == "__main__":
    main()
