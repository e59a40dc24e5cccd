"""Run of a command: its figures as a table, as values and as a picture, and what went wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from batchpid.arrays.array_types import Rows
from batchpid.sim import Robot, Rollout, write_recording
from batchpid.sim.diagnosis.causes import settled_envs
from batchpid.sim.diagnosis.text import cause_lines, median_and_worst, overshoot_of_settled, table
from batchpid.sim.tuning.evaluation import following_error, step_response_metrics
from batchpid.task_space.frames import pose_error

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NOT_SETTLED = 3
"""Exit status of `batchpid rollout` and `batchpid demo` where no env settles."""
SHORTEST = 1.0
"""Shortest run in which envs should settle [s]."""
LISTED = 8
"""Envs that a line lists."""
AXIS_UNITS = {"x": "m", "y": "m", "z": "m", "rx": "rad", "ry": "rad", "rz": "rad"}
"""Axes of the error of a pose, with their units."""
COLUMNS = {
    "first_error": ("first error", "{:.2g}"),
    "following_error": ("following error", "{:.2g}"),
    "steady_state_error": ("final error", "{:.2g}"),
    "final_error": ("final error", "{:.2g}"),
    "overshoot": ("overshoot", "{:.0%}"),
    "settling_time": ("settled after", "{:.2f} s"),
    "saturation_share": ("saturated", "{:.0%}"),
}
"""Figures in the table of a run, with headers and styles."""
ROLLOUT_NOTES = """\
final error: the largest in the last tenth of the run; following error: the largest |qpos - setpoint| at the ends of
ticks; settled: within 2 % of the move for good; overshoot: of joints that settled; saturated: share of samples
"""


@dataclass(frozen=True, eq=False)
class RunReport:
    """Rollout of a robot, and its report."""

    robot: Robot
    rollout: Rollout
    timestep: float
    wall: float
    """Time that the run took [s]."""
    backend: str
    """Library of the law, and kind of the calls into the engine."""
    notes: Sequence[str] = ()
    is_held: bool = True
    """Whether one setpoint was held: then robots should settle."""

    @property
    def seconds(self) -> float:
        """Simulated time [s]."""
        return self.rollout.tick * len(self.rollout.time)

    @property
    def status(self) -> int:
        """Exit status: :data:`NOT_SETTLED` if a setpoint was held and no env settled, else 0.

        In a run shorter than :data:`SHORTEST` an env only must not fail.
        """
        if not self.is_held:
            return 0
        if self.seconds < SHORTEST:
            good = self.rollout.ok.all(0)
        else:
            good = settled_envs(self.rollout, self.robot)
        if good.any():
            return 0
        return NOT_SETTLED

    @cached_property
    def columns(self) -> tuple[Sequence[str], Sequence[str], dict[str, Rows]]:
        """Names and units of the joints, or of the axes of the tool, and their figures (envs,
        joints).

        The figures are errors of a tool's pose, following errors of setpoints that move, or metrics
        of steps.
        """
        robot = self.robot
        rollout = self.rollout
        ends = slice(-max(1, len(rollout.time) // 10), None)
        # Poses of a tool have six errors, whatever the joints do.
        if rollout.tool_pose is not None:
            error = np.abs(pose_error(rollout.setpoint[..., :7], rollout.tool_pose.astype(float)))
            figures = {"first_error": error[0], "final_error": error[ends].max(0)}
            return list(AXIS_UNITS), list(AXIS_UNITS.values()), figures
        has_effort = rollout.info.control != "drive"
        # A setpoint that moves is followed; one that is held is a step, with a settling time.
        if not self.is_held:
            figures = {
                "following_error": following_error(robot, rollout),
                "final_error": following_error(robot, rollout.for_ticks(ends)),
            }
            if has_effort:
                figures["saturation_share"] = rollout.saturated.mean(0)
            return robot.joint_names, robot.units, figures
        start = robot.start
        if rollout.info.start is not None:
            start = rollout.info.start.astype(float)
        metrics = step_response_metrics(robot, rollout, start, with_effort=has_effort)
        overshoot = overshoot_of_settled(metrics.overshoot, metrics.settling_time)
        return robot.joint_names, robot.units, metrics._asdict() | {"overshoot": overshoot}

    def report(self) -> str:
        """Return the speed, a table of the joints, failed and unsettled envs, and causes."""
        names, units, figures = self.columns
        shown = [column for column in COLUMNS if column in figures]
        rows = []
        for joint, (name, unit) in enumerate(zip(names, units, strict=True)):
            cells = [
                median_and_worst(figures[column][:, joint], COLUMNS[column][1]) for column in shown
            ]
            rows.append([f"{name} [{unit}]", *cells])
        headers = ["median / worst env", *(COLUMNS[column][0] for column in shown)]
        lines = [
            self.backend,
            speed_line(self.rollout.num_envs, self.seconds, self.timestep, self.wall) + "\n",
            table(rows, headers, "l" + "r" * len(shown)),
            ROLLOUT_NOTES,
            *self._unsettled_lines(),
            *(f"Note: {note}" for note in self.notes),
        ]
        return "\n".join(lines)

    def _unsettled_lines(self) -> list[str]:
        """Return lines about envs that failed, joints that did not settle, and the causes."""
        rollout = self.rollout
        lines = []
        # Failed envs first: their joints are not counted as unsettled.
        failed = np.flatnonzero(~rollout.ok.all(0))
        if failed.size:
            first = rollout.tick * (1 + np.argmin(rollout.ok.all(1)))
            envs = ", ".join(map(str, failed[:LISTED]))
            lines.append(
                f"FAILED: {failed.size} of {rollout.num_envs} envs, the first after {first:.3g} s:"
                f" env {envs}{', ...' if failed.size > LISTED else ''}."
            )
        # A trajectory ends where it ends: its last setpoint need not be reached.
        if not self.is_held:
            return lines
        settling = self.columns[2].get("settling_time")
        if settling is not None:
            # Followers do what their leaders do.
            counts = np.isinf(settling[rollout.ok.all(0)]).sum(0) * self.robot.independent
            named = zip(self.robot.joint_names, counts, strict=True)
            joints = [f"{name} ({count})" for name, count in named if count]
            within = f"within {self.seconds:g} s to 2 % of"
            if joints:
                lines.append(
                    f"NOT SETTLED {within} the move, with the number of envs: {', '.join(joints)}."
                )
            elif not failed.size:
                lines.append(f"Every joint of every env settled {within} its move.")
        return lines + list(cause_lines(rollout.findings(self.robot)))

    def save(self, path: Path) -> None:
        """Write the recording."""
        write_recording(self.rollout, path, overwrite=True)

    def figure(self) -> Figure:
        """Draw the step responses."""
        from batchpid.sim import plots

        info = self.rollout.info
        title = f"{self.robot.name}, {info.engine}, control {info.control}"
        return plots.step_responses(self.rollout, title=title)


def speed_line(
    num_envs: int,
    simulated: float,
    timestep: float,
    wall: float,
) -> str:
    """Return the speed of a run: ``simulated`` seconds of ``num_envs`` robots in ``wall``
    seconds.
    """
    factor = simulated / wall
    return (
        f"{num_envs * factor / timestep:,.0f} env-steps/s: {simulated:g} s of {num_envs} robots in"
        f" {wall:.2f} s; real-time factor {factor:.3g} per robot, {num_envs * factor:.3g} in total"
    )
