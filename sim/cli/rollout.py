"""``batchpid rollout``: N of any robot hold a setpoint or follow a trajectory; the run is written
to a file.
"""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from batchpid.arrays.array_types import Array, Document
from batchpid.checks.validate import array
from batchpid.errors import InvalidArgumentError
from batchpid.sim import OperationalSpace, Recorder, Robot
from batchpid.sim.cli import flags
from batchpid.sim.cli.outputs import OutputFiles, write_figures
from batchpid.sim.recording.recording_files import HDF5
from batchpid.sim.tool_space.osc_controller import default_tool
from batchpid.sim.tuning.gain_sets import gain_set

if TYPE_CHECKING:
    from batchpid.sim.recording.setpoint_files import Setpoints

RUNNER = flags.runner_flags()


@dataclass(frozen=True)
class RolloutCommand:
    """Move N of any robot to a setpoint or along a trajectory; print a table and write the run to a
    file.

    Robots start from seeded poses. The file holds time (ticks,), setpoint, qpos, qvel, effort and
    saturated (ticks, envs, joints), ok (ticks, envs), with --control osc tool_pose (ticks, envs,
    7), and the robot's joint names, units and limits. The exit status is 3 if no robot settles at
    its setpoint; the report says why.
    """

    robot: flags.RobotName = "panda"
    num_envs: flags.NumEnvs = 64
    gains: flags.Gains = None
    control: Literal["pid", "drive", "osc"] = "pid"
    """Batch PID, PhysX's internal drive, or operational-space control of a tool."""
    tool: Annotated[str | None, tyro.conf.arg(metavar="LINK", help_behavior_hint="")] = None
    """With --control osc: link to move. Default: the last one of the longest chain."""
    setpoint: flags.OptionalFloats = None
    """One position per joint [rad or m]; with --control osc x y z qw qx qy qz of the tool. Default:
    the bundled robot's target, else the start pose; with --control osc the pose of the tool
    there.
    """
    trajectory: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="")] = None
    """Setpoints to follow instead: a CSV file with the columns time, setpoint:JOINT ..., and, where
    they are known, setpoint_rate:JOINT ... and setpoint_acceleration:JOINT ... A row holds at its
    time, and rows are equally spaced: by a tick. The first is at 0, with the start pose of env 0,
    or at the end of the first tick.
    """
    rates: bool = True
    """--no-rates: give robots no rates of the setpoints, for a recording that `batchpid identify`
    reads.
    """
    seconds: flags.Seconds = 2.0
    timestep: Annotated[float, flags.BOUNDS["timestep"]] = 1 / 2000
    """Time step of simulation and control [s]."""
    substeps: Annotated[int, flags.BOUNDS["substeps"]] = 20
    """Sim steps of a tick, from one sample to the next."""
    seed: flags.Seed = 0
    """Seed of the start poses."""
    spread: flags.Distance = 0.3
    """Largest distance of a start pose from the robot's own, with --control osc from its target,
    with --trajectory from its first row at time 0 [rad or m]; env 0 starts at that itself.
    """
    runner: Annotated[flags.RunnerFlags, flags.group(RUNNER)] = field(default_factory=RUNNER)
    dissipation: Literal["urdf", "sapien"] = "urdf"
    """Joint friction and damping as in the URDF, or SAPIEN's defaults."""
    randomize: flags.Randomize = None
    actuators: flags.Actuators = None
    meshes: flags.Meshes = field(default_factory=flags.MeshOptions)
    out: flags.OptionalPath = None
    """Recording to write, .h5: tick by tick, for plot and view."""
    picture: flags.OptionalPath = None
    """Step responses to draw: .png or .svg."""
    json: flags.Json = None
    force: flags.Force = False

    imports = ("batchpid.sim.plots", "batchpid.sim.runner.runner")

    def run(self) -> int:
        """Run the command; return the exit status, 3 if a setpoint was held and no env settles."""
        from batchpid.sim import Runner, plots
        from batchpid.sim.cli.report import exit_status, run_figures
        from batchpid.sim.cli.run import held, simulate, start_poses
        from batchpid.sim.engine.protocol import load_engine
        from batchpid.sim.tuning.randomization_files import load_randomization

        outputs = OutputFiles(self)
        out = outputs.path("out", self.out, HDF5)
        picture = outputs.path("picture", self.picture, plots.FORMATS)
        json = outputs.path("json", self.json, (".json",))
        robot = Robot.load(
            self.robot, actuators=self.actuators, dissipation=self.dissipation, **vars(self.meshes)
        )
        options: Document = {"timestep": self.timestep, "substeps": self.substeps}
        options |= self.runner.options() | {"control": self.control}
        if self.randomize is not None:
            options["randomization"] = load_randomization(self.randomize, robot)

        # Gains, or the controller of a tool.
        columns = robot.joint_names
        goal: Array = robot.target
        if self.control == "osc":
            flags.refuse(self, ("gains",), "are for the control of joints")
            options["control"] = control = OperationalSpace(
                robot, self.tool or default_tool(robot), posture=robot.target
            )
            goal, columns = control.tool_pose(robot.target), control.command.names
            title = f"{robot.name}, control osc of {control.link}"
        else:
            flags.refuse(self, ("tool",), "is for control 'osc'")
            gains = gain_set(robot, self.gains or ("drive" if self.control == "drive" else None))
            options["params"] = gains.params
            if gains.control == "drive":
                options["control"] = "drive"
            title = f"{robot.name}, control {options['control']}, gains {gains.name}"

        # Setpoints: of a file, or one that is held.
        center, rates = robot.target if self.control == "osc" else robot.start, Document()
        if self.trajectory is not None:
            motion = self._read(robot, self.trajectory)
            setpoints, options["substeps"] = motion.position, motion.substeps
            center = center if motion.start is None else motion.start
            if self.rates:
                rates = {
                    "setpoint_rates": motion.rate,
                    "setpoint_accelerations": motion.acceleration,
                }
        else:
            goal = goal if self.setpoint is None else self.setpoint
            goal = array("setpoint", goal, (1, len(columns)), columns, kind="entry")[0]
            setpoints = held(goal, self.seconds, self.timestep * self.substeps)

        engine = load_engine(options["engine"]).title
        print(f"{title}, {1 / self.timestep:g} Hz: {self.num_envs} robots in {engine}", flush=True)
        with (
            Runner(robot, self.num_envs, **options) as runner,
            (
                nullcontext()
                if out is None
                else Recorder(out, runner, seed=self.seed, overwrite=self.force)
            ),
        ):
            start = start_poses(robot, self.num_envs, self.spread, self.seed, center)
            rollout, report = simulate(runner, start, setpoints, **rates)
        print(report)
        if robot.settings is not None and self.setpoint is None:
            print(*(f"Note: {note}" for note in robot.settings.notes), sep="\n")
        if out is not None:
            print(f"written: {out}")
        if json is not None:
            write_figures(json, run_figures(robot, rollout))
            print(f"figures: {json}")
        if picture is not None:
            figure = plots.step_responses(rollout, mark=0, title=title)
            print(f"picture: {plots.save(figure, picture)}")
        return 0 if self.trajectory is not None else exit_status(robot, rollout)

    def _read(self, robot: Robot, path: Path) -> Setpoints:
        """Return the setpoints in a file, and print the source of their rates."""
        from batchpid.sim.recording.setpoint_files import read_setpoints

        if self.control == "osc":
            remedy = "leave one of them out; a trajectory has joint setpoints"
            raise InvalidArgumentError("trajectory", "excludes --control osc", remedy=remedy)
        flags.refuse(self, ("setpoint", "seconds", "substeps"), "is as --trajectory says")
        setpoints = read_setpoints(robot, path, self.timestep)
        rates = "central differences of the rows"
        if not self.rates:
            rates = "not given"
        elif setpoints.has_rates:
            rates = "from the file"
        elif setpoints.steps:
            rates += (
                f"; {setpoints.steps} changes are too fast for the velocity limits: steps, with"
                " rate 0"
            )
        print(f"Rates of the setpoints: {rates}.\n")
        return setpoints
