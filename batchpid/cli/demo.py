"""``batchpid demo``: the main job, end to end, with something to look at."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Demo:
    """64 arms in 64 headless scenes close on the tutorial's setpoint under one batch PID."""

    robot: str = "panda"
    """A bundled robot: panda or jaco2."""
    num_envs: int = 64
    """How many robots."""
    workers: int = 2
    """Processes that step them; 0: this one."""
    seconds: float = 2.0
    """Simulated time [s]."""
    seed: int = 0
    """Of the start poses."""

    def run(self) -> int:
        """Run it; returns the exit status."""
        import time

        import numpy as np

        from batchpid.cli.progress import bar
        from sim import Robot, Runner

        robot = Robot.load(self.robot)
        assert robot.settings is not None
        random = np.random.default_rng(self.seed)
        qpos = robot.start + random.uniform(-0.3, 0.3, (self.num_envs, robot.dof))
        qpos[0] = robot.start
        qpos = np.clip(qpos, robot.lower, robot.upper)
        with Runner(robot, self.num_envs, workers=self.workers, substeps=10) as runner:
            runner.reset(qpos=qpos)
            ticks = round(self.seconds / (runner.timestep * runner.substeps))
            setpoints = np.broadcast_to(robot.settings.target, (ticks, robot.dof))
            began = time.perf_counter()
            rollout = runner.rollout(setpoints, progress=bar("demo"))
            wall = time.perf_counter() - began
        print(f"{ticks * 10 * self.num_envs / wall:.0f} env-steps/s")
        error = np.abs(rollout.qpos[-1] - robot.settings.target)
        for name, column in zip(robot.joint_names, error.T, strict=True):
            print(f"{name}: final error median {np.median(column):.3g}, worst {column.max():.3g}")
        return 0
