"""Table of each physics preset's errors: ``python bench/accuracy.py [--json FILE]`` (two minutes).

The figures do not depend on the machine's speed. ``batchpid bench`` measures the speed of the presets.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from batchpid.io.files import write_atomically
from batchpid.sim import Robot
from batchpid.sim.benchmark.accuracy import REFERENCES, measure_errors
from batchpid.sim.benchmark.workload import TIMESTEP
from batchpid.sim.cli.report import table

EVERY = 20
"""Sim steps from one written error to the next."""


@dataclass(frozen=True)
class Options:
    """Errors of the physics presets against references 20 times finer, under the robots' tuned gains."""

    count: int = 8
    """Number of moves of each kind."""
    seconds: float = 1.0
    """Length of a move."""
    json: Path | None = None
    """File for the figures."""


def main(options: Options) -> None:
    """Print the table and write the figures."""
    figures: list[dict[str, Any]] = []
    for name in Robot.bundled():
        for motion in REFERENCES:
            errors = measure_errors(Robot.load(name), motion, count=options.count, seconds=options.seconds)
            for (physics, reference), error in errors.items():
                figures.append(
                    {
                        "robot": name,
                        "motion": motion,
                        "physics": physics,
                        "reference": reference,
                        "max": error.largest,
                        "rms": error.rms,
                        "over_time": {
                            "seconds": EVERY * TIMESTEP,
                            "max": [float(f"{value:.3g}") for value in error.over_time[EVERY - 1 :: EVERY]],
                        },
                    }
                )
    labels = ("robot", "motion", "physics", "reference")
    rows = [[str(row[label]) for label in labels] + [f"{row['max']:.1e}", f"{row['rms']:.1e}"] for row in figures]
    print(table(rows, [*labels, "max [rad]", "RMS [rad]"], "llllrr"))
    if options.json is not None:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(options.json, json.dumps({"accuracy": figures}) + "\n")


if __name__ == "__main__":
    main(tyro.cli(Options))
