"""``batchpid survey``: many robots, each loaded, built and moved, in a table."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from batchpid.arrays.field_tables import Field
from batchpid.io.files import write_atomically
from batchpid.sim.cli import flags
from batchpid.sim.cli.outputs import OutputFiles, bar, write_figures
from batchpid.sim.runner_keywords import DEFAULT_ENGINE

if TYPE_CHECKING:
    from batchpid.sim.tuning.robot_survey import RobotReport


@dataclass(frozen=True)
class SurveyCommand:
    """Load, build and move many robots, each in a separate process, and list how far each gets.

    Gains are designed per mass matrix. A move has settled if every joint stays within 2 % of it and ends within 1e-3
    rad (or m) of the setpoint.
    """

    paths: Annotated[
        tuple[Path, ...],
        tyro.conf.Positional,
        tyro.conf.arg(metavar="PATHS [PATHS ...]", help_behavior_hint="(required)"),
    ]
    """URDF and MJCF files, and folders that are searched for both: *.urdf, and *.xml or *.mjcf with a <mujoco> that no
    other file includes."""
    moves: Annotated[int, Field(low=1, high=1000)] = 8
    """Number of moves of each robot."""
    seed: flags.Seed = 0
    """Seed of the moves."""
    seconds: flags.MoveSeconds = 2.0
    """Simulated time of each move [s]."""
    bandwidth: Annotated[float, Field("Hz", low=1e-3, high=100.0)] = 2.0
    """Bandwidth of the designed gains [Hz]."""
    engine: flags.Engine = DEFAULT_ENGINE
    physics: flags.Physics = "accurate"
    time_limit: Annotated[float, Field("s", low=1.0, high=1e6)] = 300.0
    """Wall-clock time for each robot [s]."""
    workers: flags.Workers = None
    meshes: flags.Meshes = field(default_factory=flags.MeshOptions)
    json: flags.Json = None
    """Reports to write: a list of objects, .json."""
    out: flags.OptionalPath = None
    """Table to write in Markdown, .md."""
    force: flags.Force = False

    imports = ("batchpid.sim.tuning.robot_survey",)

    def run(self) -> int:
        """Run the command; the exit status is 1 if a robot crashed its process."""
        from batchpid.sim.options import worker_count
        from batchpid.sim.tuning.robot_survey import find_robots, survey

        outputs = OutputFiles(self)
        json_path = outputs.path("json", self.json, (".json",))
        out = outputs.path("out", self.out, (".md",))
        urdfs = find_robots(self.paths)
        reports = survey(
            urdfs,
            bandwidth_hz=self.bandwidth,
            processes=max(1, worker_count(self.workers)),
            **flags.chosen(self, "moves seed seconds engine physics time_limit"),
            **vars(self.meshes),
        )
        done = list(bar("surveying", unit="robot", total=len(urdfs))(reports))
        if json_path is not None:
            write_figures(json_path, [report.asdict() for report in done])
        if out is not None:
            out.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(out, survey_table(done, "github") + "\n")
        print(survey_table(done, "simple"))
        print(f"\n{survey_summary(done)}")
        return int(any(report.error and "the process ended" in report.error for report in done))


def survey_table(reports: Sequence[RobotReport], style: str) -> str:
    """Return the reports as a table in one of tabulate's styles; paths are relative to the folder that holds all."""
    from tabulate import tabulate

    shared = os.path.commonpath([os.path.dirname(os.path.abspath(report.urdf)) for report in reports])
    rows = [
        [
            os.path.relpath(os.path.abspath(report.urdf), shared),
            "-" if report.dof is None else str(report.dof),
            f"{report.settled} of {report.moves}" if report.moves else "-",
            "-" if report.worst_error is None else f"{report.worst_error:.0e}",
            "-" if report.worst_overshoot is None else f"{report.worst_overshoot:.0%}",
            report.error or ", ".join(report.findings),
        ]
        for report in reports
    ]
    headers = ["file", "joints", "settled", "worst error", "overshoot", "findings, or what went wrong"]
    sides = ("left", "right", "right", "right", "right", "left")
    return tabulate(rows, headers, tablefmt=style, disable_numparse=True, colalign=sides)


def survey_summary(reports: Sequence[RobotReport]) -> str:
    """Return one sentence with the number of robots that got through each stage."""
    robots = [report for report in reports if report.dof != 0]
    drawn = [report for report in robots if report.moves]
    settled = [report for report in drawn if report.settled == report.moves]
    return (
        f"{sum(report.loads for report in robots)} of {len(robots)} files with a moving joint load, {len(drawn)} get "
        f"moves, {len(settled)} settle on all of them ({len(reports) - len(robots)} files without a moving joint)."
    )
