"""``batchpid rollout``: N of any robot hold a setpoint; the run is written to a file."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from batchpid.checks.validate import array, number
from batchpid.errors import InvalidArgumentError
from batchpid.sim import OperationalSpace, Recorder, Robot, write_recording
from batchpid.sim.cli import flags
from batchpid.sim.cli.outputs import Outputs
from batchpid.sim.tool_space.osc_controller import default_tool
from batchpid.sim.tool_space.tool_goals import default_goal
from batchpid.sim.tuning.gain_sets import gain_set
from batchpid.task_space import load_osc_options


@dataclass(frozen=True)
class RolloutCommand:
    """Move N of any robot from seeded poses to a setpoint; print a table and write the run to a file.

    The file holds time (ticks,), setpoint, qpos, qvel, effort and saturated (ticks, envs, joints), ok (ticks, envs),
    with --control osc tool_pose (ticks, envs, 7), and the robot's joint names, units and limits.
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
    target, else the start pose; with --control osc a pose near that, which all robots reach within joint limits."""
    trajectory: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="")] = None
    """CSV to follow in place of --setpoint, with columns time, setpoint:JOINT, and if known setpoint_rate:JOINT. A row
    holds at its time; one at time 0 is the start. Rates are by default differences of the rows."""
    rates: bool = True
    """With --no-rates the trajectory's setpoints have none, as a recording for `batchpid identify` needs it."""
    seconds: Annotated[float | None, tyro.conf.arg(help_behavior_hint="")] = None
    """Simulated time [s]. Default: 2, or that of the trajectory."""
    timestep: float = 1 / 2000
    """Time step of simulation and control [s]."""
    substeps: Annotated[int | None, tyro.conf.arg(help_behavior_hint="")] = None
    """Sim steps of a tick, from one sample to the next. Default: 20, or those from row to row of the trajectory."""
    seed: int = 0
    """Seed of the start poses."""
    spread: float = 0.3
    """Largest distance of a start pose from the robot's own, with --control osc from the bundled robot's target [rad or
    m]; env 0 starts at that itself."""
    compensate: flags.Compensate = "gravity+coriolis+friction"
    engine: flags.Engine = "sapien"
    physics: flags.Physics = "accurate"
    backend: flags.Backend = "numpy"
    collisions: flags.Collisions = True
    dissipation: Literal["urdf", "sapien"] = "urdf"
    """Joint friction and damping as in the URDF, or SAPIEN's defaults."""
    randomize: flags.Randomize = None
    workers: flags.Workers = None
    cluster: flags.Cluster = None
    actuators: flags.Actuators = None
    meshes: flags.Meshes = field(default_factory=flags.MeshOptions)
    out: flags.OptionalPath = None
    """Recording to write: .npz at the end, or .h5 tick by tick (extra `record`). For plot, view and render."""
    picture: flags.OptionalPath = None
    """Step responses to draw: .png or .svg."""
    force: flags.Force = False

    imports = ("batchpid.sim.plots", "batchpid.sim.runner")

    def run(self) -> None:
        """Run the command."""
        from batchpid.sim import Runner, plots
        from batchpid.sim.cli.run import follow, hold_pose, hold_setpoint, read_trajectory, read_variation, start_poses

        outputs = Outputs(force=self.force)
        out = outputs.path("out", self.out, (".npz", ".h5", ".hdf5"))
        picture = outputs.path("picture", self.picture, plots.FORMATS)
        robot = Robot.load(self.robot, actuators=self.actuators, dissipation=self.dissipation, **vars(self.meshes))
        robot, randomization = read_variation(robot, self.randomize)
        seconds = number("seconds", 2.0 if self.seconds is None else self.seconds, 1e-6, 1e6, "simulated time")
        self._check_trajectory()
        target = robot.start if robot.settings is None else robot.settings.target
        params: Any = None
        path = None
        if osc := self.control == "osc":
            options = {} if self.gains is None else load_osc_options(self._osc_file(self.gains))
            control: Any = OperationalSpace(robot, self.tool or default_tool(robot), posture=target, **options)
            start = start_poses(robot, self.num_envs, self.spread, self.seed, target)
            if self.setpoint is None:
                near = start_poses(robot, 8, self.spread, self.seed + 1, target)
                setpoint = default_goal(robot, control, start, near[1:])
            else:
                setpoint = array("setpoint", self.setpoint, (1, 7), control.command.names, kind="entry")[0]
        else:
            path = None if self.trajectory is None else read_trajectory(robot, self.trajectory, self.timestep)
            start = start_poses(robot, self.num_envs, self.spread, self.seed, None if path is None else path.start)
            goal: Any = target if self.setpoint is None else self.setpoint
            setpoint = array("setpoint", goal, (1, robot.dof), robot.joint_names)[0]
            gains = gain_set(robot, self.gains or ("drive" if self.control == "drive" else None))
            params, control = gains.params, "drive" if gains.control == "drive" else self.control
        with Runner(
            robot,
            self.num_envs,
            params=params,
            control=control,
            substeps=path.substeps if path else 20 if self.substeps is None else self.substeps,
            **flags.chosen(self, "tool workers cluster timestep compensate engine physics backend collisions"),
            randomization=randomization,
        ) as runner:
            streamed = out is not None and out.suffix.lower() != ".npz"
            with Recorder(out, runner, seed=self.seed, overwrite=self.force) if out and streamed else nullcontext():
                if path is not None:
                    rollout, report = follow(runner, start, path, self.rates)
                else:
                    rollout, report = (hold_pose if osc else hold_setpoint)(runner, start, setpoint, seconds)
        if out is not None and not streamed:
            write_recording(rollout, out, seed=self.seed, overwrite=True)
        print(report)
        if out is not None:
            print(f"written: {out}")
        if picture is not None:
            figure = plots.step_responses(rollout, mark=0, title=robot.name)
            print(f"picture: {plots.save(figure, picture)}")

    def _check_trajectory(self) -> None:
        """Raise InvalidArgumentError for flags that a trajectory replaces, or that cannot follow one."""
        if self.trajectory is None:
            return
        for name in ("setpoint", "seconds", "substeps"):
            if getattr(self, name) is not None:
                raise InvalidArgumentError(name, "is given by the trajectory", remedy=f"leave out --{name}")
        if self.control == "osc":
            remedy = "use --control pid or drive"
            raise InvalidArgumentError("control", "'osc' follows poses, and a trajectory is of joints", remedy=remedy)

    def _osc_file(self, name: str) -> Path:
        """Return the path of the gains for ``--control osc``."""
        if not (path := Path(name)).is_file():
            problem = "is not a file, and --control osc has no gains by name"
            remedy = "give a file of batchpid tune --control osc, or leave it out"
            raise InvalidArgumentError("gains", problem, value=name, remedy=remedy)
        return path
