"""``batchpid rollout``: N of any robot hold a setpoint; what happened goes to a file."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from sim.cli.optional import OptionalFloats, OptionalInt, OptionalPath, OptionalStr

if TYPE_CHECKING:
    from sim import Robot, Runner
    from sim.cli.follow import Followed

FORMATS = (".npz", ".h5", ".hdf5")


@dataclass(frozen=True)
class Rollout:
    """N robots follow a setpoint from seeded poses; ends with speed and a table, and writes what happened to a file.

    The file holds time, setpoint, qpos, qvel, effort, saturated and ok, each with ticks first, then envs, then
    joints, and the robot's joint names, units and limits beside them.
    """

    robot: str = "panda"
    """A bundled robot, or the path of a URDF."""
    num_envs: int = 64
    """How many robots."""
    workers: OptionalInt = None
    """Processes that step them; 0: this one. Default: one for each available core."""
    control: Literal["pid", "drive"] = "pid"
    """The batch PID, or PhysX's internal drive."""
    seconds: float = 2.0
    """Simulated time [s]."""
    compensate: Literal["gravity+coriolis", "gravity", "none"] = "gravity+coriolis"
    """Passive force added at every sim step."""
    physics: Literal["accurate", "fast"] = "accurate"
    """Solver settings."""
    dissipation: Literal["urdf", "sapien"] = "urdf"
    """Joint friction and damping as the URDF says, or what SAPIEN gives every joint and link unasked."""
    timestep: float = 1 / 2000
    """Of simulation and control [s]."""
    substeps: int = 20
    """Sim steps from one sample to the next."""
    seed: int = 0
    """Of the start poses."""
    spread: float = 0.3
    """Envs but the first start up to this far from the robot's start pose [rad or m]."""
    setpoint: OptionalFloats = None
    """One position per joint [rad or m]. Default: the robot's own, else its start pose."""
    params: OptionalStr = None
    """Gains: a .yaml or .json file that `batchpid tune` or batchpid.save_params wrote, or one of tuned, designed,
    tutorial, drive:STIFFNESS,DAMPING. Default: a bundled robot's own, which are the tutorial's, else designed."""
    out: OptionalPath = None
    """File to write: .npz at the end, or .h5 tick by tick (extra `record`), which `batchpid plot` draws."""
    picture: OptionalPath = None
    """Step responses to draw: .png or .svg."""

    def run(self) -> None:
        """Run it."""
        import numpy as np

        from batchpid.validate import array
        from sim import Robot, Runner, plots
        from sim.cli import report
        from sim.cli.follow import duration, follow, start_poses
        from sim.tuning.evaluation import step_response_metrics
        from sim.tuning.gain_sets import gain_set

        if self.out is not None:
            _check_out(self.out)
        if self.picture is not None:
            plots.check_path(self.picture)
        robot = Robot.load(self.robot, dissipation=self.dissipation)
        seconds = duration(self.seconds)
        start = start_poses(robot, self.num_envs, self.spread, self.seed)
        settings = robot.settings
        goal: Any = self.setpoint
        if goal is None:
            goal = robot.start if settings is None else settings.target
        setpoint = array("setpoint", goal, (1, robot.dof), robot.joint_names)[0]
        options: dict[str, Any] = {"control": self.control}
        named = self.params or (None if settings is not None else "designed")
        if named is not None:
            gains = gain_set(robot, named)
            options |= {"params": gains.params, "control": gains.control}
        with (
            Runner(
                robot,
                self.num_envs,
                workers=self.workers,
                timestep=self.timestep,
                substeps=self.substeps,
                compensate=self.compensate,
                physics=self.physics,
                **options,
            ) as runner,
            _recording(self.out, runner, self.seed),
        ):
            run = follow(runner, setpoint, start, seconds, "simulating")
        metrics = step_response_metrics(robot, run.rollout, run.start)
        print(report.speed(self.num_envs, run.steps, self.timestep, run.wall) + "\n")
        print(report.joint_table(robot, metrics) + "\n")
        for verdict in report.verdicts(robot, run.rollout, metrics):
            print(verdict)
        if self.params is None and settings is not None and not np.isfinite(metrics.settling_time).all():
            print("These are the tutorial's gains. For some that settle add: --params tuned")
        if self.out is not None:
            if self.out.suffix == ".npz":
                _write(self.out, robot, run)
            print(f"written: {self.out}")
        if self.picture is not None:
            traces = plots.Traces.of(run.rollout, robot)
            print(f"picture: {plots.save(plots.step_responses(traces, mark=0, title=robot.name), self.picture)}")


def _recording(path: Path | None, runner: Runner, seed: int) -> AbstractContextManager[Any]:
    """A recorder for HDF5 files; it has made what is recorded so far safe whenever the run is cut short."""
    from sim import Recorder

    if path is None or path.suffix == ".npz":
        return nullcontext()
    path.parent.mkdir(parents=True, exist_ok=True)
    return Recorder(path, runner, seed=seed, overwrite=True)


def _check_out(path: Path) -> None:
    from batchpid.errors import InvalidArgumentError

    if path.suffix not in FORMATS:
        raise InvalidArgumentError(
            "out", "unknown file format", value=str(path), remedy=f"end it in {' or '.join(FORMATS)}"
        )


def _write(path: Path, robot: Robot, run: Followed) -> None:
    import numpy as np

    path.parent.mkdir(parents=True, exist_ok=True)
    arrays: dict[str, Any] = run.rollout.arrays()
    np.savez_compressed(
        path,
        **arrays,
        tick=run.rollout.tick,
        start=run.start,
        robot=np.array(robot.name),
        joint_names=np.array(robot.joint_names),
        units=np.array([joint.unit for joint in robot.joints]),
        lower=robot.lower,
        upper=robot.upper,
        effort_limit=robot.effort_limit,
    )
