"""``batchpid rollout``: N of any robot hold a setpoint or follow a trajectory. ``batchpid demo``:
the same in one call.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from batchpid.arrays.array_types import Document, Float64, Progress, Rows
from batchpid.arrays.field_tables import Field
from batchpid.checks.validate import array
from batchpid.errors import InvalidArgumentError
from batchpid.sim import OperationalSpace, Robot
from batchpid.sim.cli.flags import BOUNDS, Gains, NumEnvs, Randomize, flag
from batchpid.sim.cli.report import RunReport
from batchpid.sim.tuning.evaluation import load_randomization
from batchpid.sim.tuning.gain_sets import gain_set

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
    seconds: Seconds = None,
    progress: Progress[int] | None = None,
    **options: Any,
) -> RunReport:
    """Move 64 arms to a setpoint; print a table of the joints and draw a picture.

    PID and passive force are computed at each of the 2000 sim steps of a second. Env 0 starts where
    SAPIEN's tutorial does, the others at seeded poses near it.
    """
    return rollout(robot, num_envs, seconds=seconds, progress=progress, **options)


def rollout(
    robot: Robot,
    num_envs: NumEnvs = 64,
    gains: Gains = None,
    control: Annotated[
        Literal["pid", "drive", "osc"],
        flag("Batch PID, the engine's internal drive, or operational-space control of the tool."),
    ] = "pid",
    setpoint: Annotated[
        tuple[float, ...] | None,
        flag(
            "One position per joint [rad or m]; with --control osc x y z qw qx qy qz of the tool."
            " Default: robot.target, the bundled robot's or, of another robot, a quarter of the way"
            " from the start pose to the farther limit of each joint, at most 0.5; with --control"
            " osc the pose of the tool there.",
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
    **options: Any,
) -> RunReport:
    """Move N of any robot to a setpoint or along a trajectory; print a table.

    To a setpoint robots start from seeded poses. The recording holds time (ticks,), setpoint, qpos,
    qvel, effort and saturated (ticks, envs, joints), ok (ticks, envs), with --control osc tool_pose
    (ticks, envs, 7), and the robot's joint names, units and limits. The exit status is 3 if no
    robot settles at its setpoint; the report says why.
    """
    from batchpid.sim.runner.runner import Runner

    randomization = load_randomization(randomize, robot)
    options |= {"timestep": timestep, "randomization": randomization, "control": control}
    # Gains, or the controller of a tool.
    center: Rows = robot.start
    goal: ArrayLike = robot.target
    columns = robot.joint_names
    if control == "osc":
        _refuse("gains", gains, "are for the control of joints")
        _refuse("trajectory", trajectory, "has joint setpoints, and excludes --control osc")
        operational = OperationalSpace(robot, robot.rigid_tree.tool, posture=robot.target)
        options["control"] = operational
        columns = operational.command.names
        goal = operational.tool_pose(robot.target)
        center = robot.target
    else:
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

        _refuse("setpoint", setpoint, "is given by the trajectory")
        _refuse("seconds", seconds, "is given by the trajectory")
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
        options["substeps"] = SETPOINT_SUBSTEPS
        # The metrics of a step need two ticks.
        ticks = max(2, round((seconds or 2.0) / (timestep * SETPOINT_SUBSTEPS)))
        setpoints = np.tile(row, (ticks, 1))
        if robot.settings is not None and setpoint is None:
            notes += robot.settings.notes

    with Runner(robot, num_envs, **options) as runner:
        # The speed is that of the run alone, without the start of processes.
        began = time.perf_counter()
        # A start off the trajectory would count as an error of following.
        start = start_poses(robot, num_envs, START_SPREAD if trajectory is None else 0.0, center)
        runner.reset(start, seed=None if randomization is None else 0)
        result = runner.rollout(setpoints, progress=progress, **further)
        wall = time.perf_counter() - began
        backend = runner.backend
    return RunReport(robot, result, timestep, wall, backend, notes, is_held=trajectory is None)


def start_poses(
    robot: Robot,
    num_envs: int,
    spread: float,
    center: Rows,
) -> Float64:
    """Return poses (envs, dof) [rad or m] around ``center``, inside the limits; env 0 is that pose
    itself.

    Uniform within ``spread`` [rad or m], and within a quarter of the joint's range where that is
    less. Row k is the same for any ``num_envs``.
    """
    random = np.random.default_rng(0)
    reach = np.minimum(spread, (robot.upper - robot.lower) / 4)
    poses = center + reach * random.uniform(-1.0, 1.0, (num_envs, robot.dof))
    poses[0] = center
    return robot.coupled(np.clip(poses, robot.lower, robot.upper))


def _refuse(name: str, value: Any, problem: str) -> None:
    """Raise InvalidArgumentError for a flag that is given."""
    if value is not None:
        raise InvalidArgumentError(name, problem, value=value, remedy="leave it out")
