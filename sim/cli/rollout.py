"""``batchpid rollout``: N of any robot hold a setpoint or follow a trajectory. ``batchpid demo``:
the same in one call.
"""

from __future__ import annotations

import time
import warnings
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from batchpid.arrays.array_types import Document, Float64, Progress, Rows
from batchpid.arrays.field_tables import Field
from batchpid.checks.validate import array
from batchpid.errors import InvalidArgumentError
from batchpid.sim import OperationalSpace, Robot
from batchpid.sim.cli.flags import BOUNDS
from batchpid.sim.cli.report import RunReport
from batchpid.sim.diagnosis.run_checks import SetpointWarning
from batchpid.sim.randomization.randomization import Randomization
from batchpid.sim.tuning.gain_sets import gain_set

NumEnvs = Annotated[int, BOUNDS["num_envs"]]
SECONDS = Field("simulated time, s", low=1e-6, high=1e6)


def demo(
    robot: Robot,
    num_envs: NumEnvs = 64,
    gains: str | None = None,
    seconds: Annotated[float, SECONDS] = 2.0,
    progress: Progress[int] | None = None,
    **options: Any,
) -> RunReport:
    """Move 64 arms to a setpoint; print a table of the joints and draw a picture.

    PID and passive force are computed at each of the 2000 sim steps of a second. Env 0 starts where
    SAPIEN's tutorial does, the others at seeded poses near it.

    Parameters
    ----------
    num_envs
        Number of robots, one in each scene.
    gains
        Gains, as for `batchpid rollout`.
    seconds
        Simulated time [s].
    """
    return rollout(
        robot, num_envs, gains, seconds=seconds, substeps=10, progress=progress, **options
    )


def rollout(
    robot: Robot,
    num_envs: NumEnvs = 64,
    gains: str | None = None,
    control: Literal["pid", "drive", "osc"] = "pid",
    tool: str | None = None,
    setpoint: tuple[float, ...] | None = None,
    trajectory: Path | None = None,
    rates: bool = True,
    seconds: Annotated[float | None, SECONDS] = None,
    timestep: Annotated[float, BOUNDS["timestep"]] = 1 / 2000,
    substeps: Annotated[int | None, BOUNDS["substeps"]] = None,
    seed: Annotated[int, Field(high=2**31 - 1)] = 0,
    spread: Annotated[float, Field("rad or m", high=10.0)] = 0.3,
    randomization: Randomization | None = None,
    progress: Progress[int] | None = None,
    **options: Any,
) -> RunReport:
    """Move N of any robot to a setpoint or along a trajectory; print a table.

    Robots start from seeded poses. The recording holds time (ticks,), setpoint, qpos, qvel, effort
    and saturated (ticks, envs, joints), ok (ticks, envs), with --control osc tool_pose (ticks,
    envs, 7), and the robot's joint names, units and limits. The exit status is 3 if no robot
    settles at its setpoint; the report says why.

    Parameters
    ----------
    num_envs
        Number of robots, one in each scene.
    gains
        Gains: tuned, designed, sapien-tutorial, mjcf, drive:STIFFNESS,DAMPING, or a params file
        (.yaml or .json) that `batchpid tune` or batchpid.save_params wrote. Default: tuned where
        the robot has them, else designed.
    control
        Batch PID, the engine's internal drive, or operational-space control of a tool.
    tool
        With --control osc: link to move. Default: the last one of the longest chain.
    setpoint
        One position per joint [rad or m]; with --control osc x y z qw qx qy qz of the tool.
        Default: the bundled robot's target, else the start pose; with --control osc the pose of the
        tool there.
    trajectory
        Setpoints to follow instead: a CSV file with the columns time, setpoint:JOINT ..., and,
        where they are known, setpoint_rate:JOINT ... and setpoint_acceleration:JOINT ... A row
        holds at its time, and rows are equally spaced: by a tick. The first is at 0, with the start
        pose of env 0, or at the end of the first tick.
    rates
        --no-rates: give robots no rates of the setpoints, for a recording that `batchpid identify`
        reads.
    seconds
        Simulated time [s]. Default: 2, or as long as the trajectory.
    timestep
        Time step of simulation and control [s].
    substeps
        Sim steps of a tick, from one sample to the next. Default: 20, or as the trajectory's rows.
    seed
        Seed of the start poses.
    spread
        Largest distance of a start pose from the robot's own, with --control osc from its target,
        with --trajectory from its first row at time 0 [rad or m]; env 0 starts at that itself.
    randomization
        Draw the robot of each env: a YAML file (docs/randomization.md), e.g. `payload: {uniform:
        [0, 0.5]}`.
    """
    from batchpid.sim.runner.runner import Runner

    options |= {"timestep": timestep, "randomization": randomization, "control": control}
    # Gains, or the controller of a tool.
    center: Rows = robot.start
    goal: ArrayLike = robot.target
    columns = robot.joint_names
    if control == "osc":
        _refuse("gains", gains, "are for the control of joints")
        _refuse("trajectory", trajectory, "has joint setpoints, and excludes --control osc")
        operational = OperationalSpace(robot, tool or robot.rigid_tree.tool, posture=robot.target)
        options["control"] = operational
        columns = operational.command.names
        goal = operational.tool_pose(robot.target)
        center = robot.target
    else:
        _refuse("tool", tool, "is for control 'osc'")
        # Without gains the Runner has its own default, which knows the loops of an MJCF file.
        if gains is not None:
            chosen = gain_set(robot, gains)
            options["params"] = chosen.params
            if chosen.control == "drive":
                options["control"] = "drive"

    # Setpoints: of a file, or one that is held.
    notes: list[str] = []
    further = Document()
    if trajectory is not None:
        from batchpid.sim.recording.setpoint_files import read_setpoints

        for name, value in {"setpoint": setpoint, "seconds": seconds, "substeps": substeps}.items():
            _refuse(name, value, "is given by the trajectory")
        motion = read_setpoints(robot, trajectory, timestep)
        setpoints = motion.position
        options["substeps"] = motion.substeps
        center = center if motion.start is None else motion.start
        if rates:
            further = {"setpoint_rates": motion.rate, "setpoint_accelerations": motion.acceleration}
        if motion.has_rates:
            source = "from the file"
        else:
            source = "central differences of the rows"
        notes.append(f"Rates of the setpoints: {source if rates else 'not given'}.")
        if motion.steps and rates:
            notes.append(
                f"{motion.steps} steps of the setpoints exceed the velocity limits; their rate is 0."
            )
    else:
        goal = goal if setpoint is None else setpoint
        row = array("setpoint", goal, (1, len(columns)), columns, kind="entry")[0]
        options["substeps"] = substeps = 20 if substeps is None else substeps
        # The metrics of a step need two ticks.
        ticks = max(2, round((seconds or 2.0) / (timestep * substeps)))
        setpoints = np.tile(row, (ticks, 1))
        if robot.settings is not None and setpoint is None:
            notes += robot.settings.notes

    with Runner(robot, num_envs, **options) as runner, warnings.catch_warnings():
        warnings.simplefilter("ignore", SetpointWarning)  # the report has the finding
        # The speed is that of the run alone, without the start of processes.
        began = time.perf_counter()
        start = start_poses(robot, num_envs, spread, seed, center)
        runner.reset(start, seed=None if randomization is None else 0)
        result = runner.rollout(setpoints, progress=progress, **further)
        wall = time.perf_counter() - began
        backend = runner.backend
    return RunReport(robot, result, timestep, wall, backend, notes, is_held=trajectory is None)


def start_poses(
    robot: Robot,
    num_envs: int,
    spread: float,
    seed: int,
    center: Rows,
) -> Float64:
    """Return poses (envs, dof) [rad or m] around ``center``, inside the limits; env 0 is that pose
    itself.

    Uniform within ``spread`` [rad or m], and within a quarter of the joint's range where that is
    less. Row k is the same for any ``num_envs``.
    """
    random = np.random.default_rng(seed)
    reach = np.minimum(spread, (robot.upper - robot.lower) / 4)
    poses = center + reach * random.uniform(-1.0, 1.0, (num_envs, robot.dof))
    poses[0] = center
    return robot.coupled(np.clip(poses, robot.lower, robot.upper))


def _refuse(name: str, value: Any, problem: str) -> None:
    """Raise InvalidArgumentError for a flag that is given."""
    if value is not None:
        raise InvalidArgumentError(name, problem, value=value, remedy="leave it out")
