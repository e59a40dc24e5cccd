"""``batchpid rollout``: N of any robot hold a setpoint or follow a trajectory; the run is written to a file."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from batchpid.arrays.array_types import Array
from batchpid.checks.validate import array
from batchpid.errors import InvalidArgumentError
from batchpid.sim import OperationalSpace, Recorder, Robot
from batchpid.sim.cli import flags
from batchpid.sim.cli.outputs import OutputFiles, waiting, write_figures
from batchpid.sim.recording.recording_files import HDF5
from batchpid.sim.tool_space.osc_controller import default_tool
from batchpid.sim.tuning.gain_sets import gain_set

if TYPE_CHECKING:
    from batchpid.sim.setpoint_files import Setpoints

RUNNER = flags.runner_flags()


@dataclass(frozen=True)
class RolloutCommand:
    """Move N of any robot to a setpoint or along a trajectory; print a table and write the run to a file.

    Robots start from seeded poses. The file holds time (ticks,), setpoint, qpos, qvel, effort and saturated (ticks,
    envs, joints), ok (ticks, envs), with --control osc tool_pose (ticks, envs, 7), and the robot's joint names, units
    and limits. The exit status is 3 if no robot settles at its setpoint; the report says why.
    """

    robot: flags.RobotName = "panda"
    num_envs: flags.NumEnvs = 64
    gains: flags.Gains = None
    control: Literal["pid", "drive", "osc"] = "pid"
    """Batch PID, PhysX's internal drive, or operational-space control of a tool."""
    tool: Annotated[str | None, tyro.conf.arg(metavar="LINK", help_behavior_hint="")] = None
    """With --control osc: link to move. Default: the last one of the longest chain."""
    setpoint: flags.OptionalFloats = None
    """One position per joint [rad or m]; with --control osc x y z qw qx qy qz of the tool. Default: the bundled robot's
    target, else the start pose; with --control osc the pose of the tool there."""
    trajectory: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="")] = None
    """Setpoints to follow instead: a CSV file with the columns time, setpoint:JOINT ..., and, where they are known,
    setpoint_rate:JOINT ... and setpoint_acceleration:JOINT ... A row holds at its time, and rows are equally spaced: by
    a tick. The first is at 0, with the start pose of env 0, or at the end of the first tick."""
    rates: bool = True
    """With --no-rates the setpoints of the trajectory have none, as in a recording that `batchpid identify` reads."""
    seconds: flags.Seconds = 2.0
    timestep: Annotated[float, flags.BOUNDS["timestep"]] = 1 / 2000
    """Time step of simulation and control [s]."""
    substeps: Annotated[int, flags.BOUNDS["substeps"]] = 20
    """Sim steps of a tick, from one sample to the next; with --trajectory as the times of its rows say."""
    seed: flags.Seed = 0
    """Seed of the start poses."""
    spread: flags.Distance = 0.3
    """Largest distance of a start pose from the robot's own, with --control osc from the bundled robot's target, with
    --trajectory from its first row at time 0 [rad or m]; env 0 starts at that itself."""
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

    imports = ("batchpid.sim.plots", "batchpid.sim.runner")

    def run(self) -> int:
        """Run the command; return the exit status, 3 if a setpoint was held and no env settles."""
        from batchpid.sim import Runner, plots
        from batchpid.sim.cli.report import exit_status
        from batchpid.sim.cli.run import (
            follow,
            hold_pose,
            hold_setpoint,
            run_figures,
            start_poses,
        )
        from batchpid.sim.tuning.randomization_presets import load_randomization

        outputs = OutputFiles(self)
        out = outputs.path("out", self.out, HDF5)
        picture = outputs.path("picture", self.picture, plots.FORMATS)
        json = outputs.path("json", self.json, (".json",))
        robot = Robot.load(self.robot, actuators=self.actuators, dissipation=self.dissipation, **vars(self.meshes))
        randomization = None if self.randomize is None else load_randomization(self.randomize, robot)
        target = robot.start if robot.settings is None else robot.settings.target
        setpoints = None if self.trajectory is None else self._read(robot, self.trajectory)
        params: Any = None
        if osc := self.control == "osc":
            flags.refuse(self, ("gains",), "are for the control of joints")
            control: Any = OperationalSpace(robot, self.tool or default_tool(robot), posture=target)
            start = start_poses(robot, self.num_envs, self.spread, self.seed, target)
            goal: Array = control.tool_pose(target) if self.setpoint is None else self.setpoint
            setpoint = array("setpoint", goal, (1, 7), control.command.names, kind="entry")[0]
        else:
            center = None if setpoints is None else setpoints.start
            start = start_poses(robot, self.num_envs, self.spread, self.seed, center)
            goal = target if self.setpoint is None else self.setpoint
            setpoint = array("setpoint", goal, (1, robot.dof), robot.joint_names)[0]
            gains = gain_set(robot, self.gains or ("drive" if self.control == "drive" else None))
            params, control = gains.params, "drive" if gains.control == "drive" else self.control
            if self.rates and setpoints is not None and setpoints.acceleration is not None:
                _check_accelerations(self.trajectory, control == "pid" and params.gain_units is not None)
        with waiting(f"building {self.num_envs} robots"):
            made = Runner(
                robot,
                self.num_envs,
                params=params,
                control=control,
                tool=self.tool,
                timestep=self.timestep,
                **self.runner.options(),
                substeps=self.substeps if setpoints is None else setpoints.substeps,
                randomization=randomization,
            )
        with (
            made as runner,
            Recorder(out, runner, seed=self.seed, overwrite=self.force) if out else nullcontext(),
        ):
            if setpoints is not None:
                rollout, report = follow(runner, start, setpoints, self.rates)
            else:
                rollout, report = (hold_pose if osc else hold_setpoint)(runner, start, setpoint, self.seconds)
        print(report)
        if out is not None:
            print(f"written: {out}")
        if json is not None:
            write_figures(json, run_figures(robot, rollout))
            print(f"figures: {json}")
        if picture is not None:
            figure = plots.step_responses(rollout, mark=0, title=robot.name)
            print(f"picture: {plots.save(figure, picture)}")
        return 0 if setpoints is not None else exit_status(robot, rollout)

    def _read(self, robot: Robot, path: Path) -> Setpoints:
        """Return the setpoints in a file, if no flag contradicts them."""
        from batchpid.sim.setpoint_files import read_setpoints

        others = {
            "--setpoint": self.setpoint is not None,
            "--seconds": self.seconds != RolloutCommand.seconds,
            "--control osc": self.control == "osc",
        }
        for name, is_given in others.items():
            if is_given:
                remedy = "leave one of them out; a trajectory has joint setpoints, and lasts as long as its file"
                raise InvalidArgumentError("trajectory", f"excludes {name}", remedy=remedy)
        setpoints = read_setpoints(robot, path, self.timestep)
        if self.substeps not in (RolloutCommand.substeps, setpoints.substeps):
            problem, remedy = f"differs from the ticks of {path}", f"leave it out, or use {setpoints.substeps}"
            raise InvalidArgumentError("substeps", problem, value=self.substeps, remedy=remedy)
        return setpoints


def _check_accelerations(path: Path | None, are_taken: bool) -> None:
    """Raise InvalidArgumentError unless the gains take the accelerations in a file."""
    if not are_taken:
        problem, remedy = "needs gains in accelerations", "use --gains designed, or remove the columns"
        raise InvalidArgumentError(f"{path}: column setpoint_acceleration", problem, remedy=remedy)
