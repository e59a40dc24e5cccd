"""``batchpid demo``: the main job, end to end, with something to look at."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

SUBSTEPS = 10
"""Sim steps between two samples of the picture."""
SPREAD = 0.3
"""How far from the tutorial's pose the others may start [rad]."""


@dataclass(frozen=True)
class Demo:
    """Robots close on the tutorial's setpoint, each in a headless scene, all under one batch PID.

    PID and passive force are computed at every one of the 2000 sim steps of a second. Env 0 starts where SAPIEN's
    tutorial does, the others at seeded poses around it. Ends with the speed, a table of the joints, and a picture.
    """

    robot: str = "panda"
    """A bundled robot: panda or jaco2."""
    num_envs: int = 64
    """How many robots."""
    workers: int = 2
    """Processes that step them; 0: this one."""
    seconds: float = 2.0
    """Simulated time [s]."""
    gains: Literal["tuned", "tutorial"] = "tuned"
    """Which gains: those that batchpid tune found, or SAPIEN's tutorial's, as they are."""
    seed: int = 0
    """Of the start poses."""
    out: Path = Path("out/demo.png")
    """The picture: .png or .svg."""
    viewer: bool = False
    """Play it in SAPIEN's window at the end, up to 16 robots. Needs a display and a Vulkan device."""

    def run(self) -> None:
        """Run it."""
        from batchpid.errors import InvalidArgumentError
        from sim import Robot, Runner, plots
        from sim.cli import report
        from sim.cli.follow import duration, follow, start_poses
        from sim.tuning.evaluation import step_response_metrics

        out = plots.check_path(self.out)
        if self.viewer:
            from sim.view.film import check_renderer, show_window

            check_renderer()
        robot = Robot.load(self.robot)
        settings = robot.settings
        if settings is None:
            raise InvalidArgumentError(
                "robot",
                "carries no tutorial settings to demonstrate",
                value=self.robot,
                remedy=f"use one of {', '.join(Robot.bundled())}, or batchpid rollout --robot {self.robot}",
            )
        seconds = duration(self.seconds)
        start = start_poses(robot, self.num_envs, SPREAD, self.seed)
        params = robot.tuned() if self.gains == "tuned" else robot.params()
        whose = "tuned gains" if self.gains == "tuned" else "the tutorial's gains"
        with Runner(
            robot,
            self.num_envs,
            workers=self.workers,
            timestep=1 / settings.rate_hz,
            substeps=SUBSTEPS,
            params=params,
        ) as runner:
            print(
                f"{robot.name}: {self.num_envs} robots of {robot.dof} joints, {len(runner.pids) or 1} processes, "
                f"PID and passive force at {settings.rate_hz:g} Hz, {whose}",
                flush=True,
            )
            run = follow(runner, settings.target, start, seconds, "simulating")
        metrics = step_response_metrics(robot, run.rollout, run.start)
        print(report.speed(self.num_envs, run.steps, 1 / settings.rate_hz, run.wall) + "\n")
        print(report.joint_table(robot, metrics) + "\n")
        for verdict in report.verdicts(robot, run.rollout, metrics):
            print(verdict)
        for note in settings.notes:
            print(f"Note: {note}")
        figure = plots.step_responses(
            plots.Traces.of(run.rollout, robot),
            mark=0,
            title=f"{self.num_envs} {robot.name}s under one batch PID at {settings.rate_hz:g} Hz: "
            f"{whose}, env 0 from the tutorial's pose",
        )
        print(f"\npicture: {plots.save(figure, out)}")
        if self.viewer:
            show_window(run.rollout.for_envs(slice(0, 16)))
