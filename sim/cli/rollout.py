"""``batchpid rollout``: N of any robot hold a setpoint or follow a trajectory. ``batchpid demo``:
the same in one call. Their report: figures as a table and as a picture, and what went wrong.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np

from batchpid.arrays.array_types import Document, Float64, Progress, Rows
from batchpid.arrays.field_tables import Field
from batchpid.checks import array
from batchpid.errors import InvalidArgumentError
from batchpid.io.files import imported
from batchpid.sim import Robot, Rollout, write_recording
from batchpid.sim.cli.flags import BOUNDS, Engine, Gains, NumEnvs, Randomize, Workers, flag
from batchpid.sim.diagnosis.causes import (
    cause_lines,
    median_and_worst,
    overshoot_of_settled,
    table,
)
from batchpid.sim.options.groups import DEFAULT_ENGINE
from batchpid.sim.tuning.evaluation import (
    following_error,
    load_randomization,
    step_response_metrics,
)
from batchpid.sim.tuning.gain_sets import gain_set

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLUMNS = {
    "following_error": ("following error", "{:.2g}"),
    "steady_state_error": ("final error", "{:.2g}"),
    "overshoot": ("overshoot", "{:.0%}"),
    "settling_time": ("settled after", "{:.2f} s"),
    "saturation_share": ("saturated", "{:.0%}"),
}
"""Figures in the table of a run, with headers and styles."""
ROLLOUT_NOTES = """\
final error: the largest in the last tenth of the run; following error: the largest |qpos - setpoint| at the ends of
ticks; settled: within 2 % of the move for good; overshoot: of joints that settled; saturated: share of samples
"""
SETPOINT_SUBSTEPS = 20
"""Sim steps of a tick, from one sample to the next, to a setpoint."""
START_SPREAD = 0.3
"""Largest distance of a start pose from the first one [rad or m]."""
Seconds = Annotated[
    float | None,
    Field("simulated time, s", low=1e-6, high=1e6),
    flag("Simulated time [s]. Default: 2, or as long as the trajectory."),
]


def demo(
    robot: Robot,
    num_envs: NumEnvs = 64,
    engine: Engine = DEFAULT_ENGINE,
    seconds: Seconds = None,
    progress: Progress[int] | None = None,
) -> RunReport:
    """Move 64 arms to a setpoint; print a table of the joints and draw a picture.

    PID and passive force are computed at each of the 2000 sim steps of a second. Env 0 starts where
    SAPIEN's tutorial does, the others at seeded poses near it.
    """
    return rollout(
        robot,
        num_envs,
        engine=engine,
        seconds=seconds,
        progress=progress,
    )


def rollout(
    robot: Robot,
    num_envs: NumEnvs = 64,
    engine: Engine = DEFAULT_ENGINE,
    workers: Workers = None,
    gains: Gains = None,
    setpoint: Annotated[
        tuple[float, ...] | None,
        flag(
            "One position per joint [rad or m]. Default: robot.target, the bundled robot's or, of"
            " another robot, a quarter of the way from the start pose to the farther limit of each"
            " joint, at most 0.5.",
            "FLOAT [FLOAT ...]",
        ),
    ] = None,
    trajectory: Annotated[
        Path | None,
        flag(
            "Setpoints to follow instead: a CSV file with the columns time, setpoint:JOINT ..., and,"
            " where they are known, setpoint_rate:JOINT ... and setpoint_acceleration:JOINT ... A"
            " row holds at its time, and rows are equally spaced: by a tick. The first is at 0, with"
            " the start pose, or at the end of the first tick. All robots start there.",
            "FILE",
        ),
    ] = None,
    rates: Annotated[
        bool,
        flag(
            "Give robots no rates of the setpoints (--no-rates), for a recording that `batchpid"
            " identify` reads."
        ),
    ] = True,
    seconds: Seconds = None,
    timestep: Annotated[
        float, BOUNDS["timestep"], flag("Time step of simulation and control [s].")
    ] = 1 / 2000,
    randomize: Randomize = None,
    progress: Progress[int] | None = None,
) -> RunReport:
    """Move N of any robot to a setpoint or along a trajectory; print a table.

    To a setpoint robots start from seeded poses. The recording holds time (ticks,), setpoint, qpos,
    qvel, effort and saturated (ticks, envs, joints), ok (ticks, envs), and the robot's joint names,
    units and limits.
    """
    from batchpid.sim.runner.runner import Runner

    randomization = load_randomization(randomize, robot)
    options: Document = {
        "engine": engine,
        "workers": workers,
        "timestep": timestep,
        "substeps": SETPOINT_SUBSTEPS,
        "randomization": randomization,
    }
    if gains is not None:
        # Without gains the Runner has its own default, which knows the loops of an MJCF file.
        chosen = gain_set(robot, gains)
        options |= {"params": chosen.params, "control": chosen.control}

    # Setpoints: one that is held, or the rows of a file.
    notes: list[str] = []
    inputs = Document()
    if trajectory is None:
        goal = robot.target if setpoint is None else setpoint
        row = array("setpoint", goal, (1, robot.dof), robot.joint_names)[0]
        start = start_poses(robot, num_envs)
        # The metrics of a step need two ticks.
        ticks = max(2, round((seconds or 2.0) / (timestep * SETPOINT_SUBSTEPS)))
        setpoints = np.tile(row, (ticks, 1))
        if robot.settings is not None and setpoint is None:
            notes += robot.settings.notes
    else:
        from batchpid.sim.recording.setpoint_files import read_setpoints

        for name, value in (("setpoint", setpoint), ("seconds", seconds)):
            if value is not None:
                problem = "is given by the trajectory"
                raise InvalidArgumentError(name, problem, value=value, remedy="leave it out")
        motion = read_setpoints(robot, trajectory, timestep)
        setpoints = motion.position
        # A start off the trajectory would count as an error of following.
        start = robot.start if motion.start is None else motion.start
        options["substeps"] = motion.substeps
        if rates:
            inputs = {
                "setpoint_rates": motion.rate,
                "setpoint_accelerations": motion.acceleration,
            }
        else:
            notes.append("Rates of the setpoints: not given.")

    with Runner(robot, num_envs, **options) as runner:
        # The speed is that of the run alone, without the start of processes.
        began = time.perf_counter()
        runner.reset(start, seed=None if randomization is None else 0)
        result = runner.rollout(setpoints, progress=progress, **inputs)
        wall = time.perf_counter() - began
        backend = runner.backend
    return RunReport(
        robot,
        result,
        timestep,
        wall,
        backend,
        notes,
        is_held=trajectory is None,
    )


def start_poses(robot: Robot, num_envs: int) -> Float64:
    """Return poses (envs, dof) [rad or m] around the start pose, inside the limits; env 0 is that
    pose itself.

    Uniform within :data:`START_SPREAD`, and within a quarter of the joint's range where that is
    less. Row k is the same for any ``num_envs``.
    """
    random = imported("numpy.random").default_rng(0)
    reach = np.minimum(START_SPREAD, (robot.upper - robot.lower) / 4)
    poses = robot.start + reach * random.uniform(-1.0, 1.0, (num_envs, robot.dof))
    poses[0] = robot.start
    coupled: Float64 = robot.coupling.positions(np.clip(poses, robot.lower, robot.upper))
    return coupled


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

    def _figures(self) -> dict[str, Rows]:
        """Return the figures of the joints (envs, joints): following errors of setpoints that
        move, or metrics of steps.
        """
        robot = self.robot
        rollout = self.rollout
        # A setpoint that moves is followed; one that is held is a step, with a settling time.
        if not self.is_held:
            figures = {"following_error": following_error(robot, rollout)}
            if rollout.info.control != "drive":
                figures["saturation_share"] = rollout.saturated.mean(0)
            return figures
        start = robot.start
        if rollout.info.start is not None:
            start = rollout.info.start.astype(float)
        metrics = step_response_metrics(robot, rollout, start)
        overshoot = overshoot_of_settled(metrics.overshoot, metrics.settling_time)
        return metrics._asdict() | {"overshoot": overshoot}

    def report(self) -> str:
        """Return the speed, a table of the joints, failed and unsettled envs, and causes."""
        robot = self.robot
        figures = self._figures()
        shown = [column for column in COLUMNS if column in figures]
        rows = []
        for joint, (name, unit) in enumerate(zip(robot.joint_names, robot.units, strict=True)):
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
            *self._settling_lines(),
            *(f"Note: {note}" for note in self.notes),
        ]
        return "\n".join(lines)

    def _settling_lines(self) -> Iterator[str]:
        """Yield lines about the causes for which joints did not settle, or one that all did."""
        causes = list(self.rollout.findings(self.robot))
        # A trajectory ends where it ends: its last setpoint need not be reached.
        if not self.is_held:
            causes = [cause for cause in causes if cause.code == "failed"]
        elif not causes:
            yield f"Every joint of every env settled within {self.seconds:g} s to 2 % of its move."
        yield from cause_lines(causes)

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
