"""Data of a page: robots that run while they are shown, or a recorded run; and its controls."""

from __future__ import annotations

import math
import queue
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from batchpid.arrays.array_types import Float64
from batchpid.checks import integer, number
from batchpid.errors import BatchPIDError, InvalidArgumentError
from batchpid.sim.options.options import RunnerOptions
from batchpid.sim.robot.robot import Robot
from batchpid.sim.robot.robot_options import content
from batchpid.sim.rollout import Rollout, RunInfo
from batchpid.sim.runner.runner import Runner
from batchpid.sim.signals import Observation
from batchpid.sim.view.scene import MAX_ROBOTS

if TYPE_CHECKING:
    from viser import GuiApi


HISTORY_SECONDS = 8.0
"""Longest past that the chart shows [s]."""


class LiveSimulation:
    """``num_envs`` robots under the PID, steered from the page.

    Parameters
    ----------
    period
        Simulated time between frames [s], rounded to whole sim steps.
    spread
        Largest distance of a joint from the robot's start pose at the beginning [rad or m].
    options
        Of :class:`batchpid.sim.Runner`: params, workers, engine, physics, compensate, timestep, ...

    Raises
    ------
    InvalidArgumentError
        An argument is out of range, before any process starts.
    """

    def __init__(
        self,
        robot: Robot,
        num_envs: int,
        *,
        period: float = 1 / 30,
        spread: float = 0.2,
        **options: Any,
    ) -> None:
        self.robot = robot
        self.num_envs = integer("num_envs", num_envs, 1, MAX_ROBOTS)
        timestep = options.get("timestep", RunnerOptions.timestep)
        period = number("period", period, timestep, 1.0, "seconds between frames")
        substeps = round(period / timestep)
        self.period = substeps * timestep
        self._random = np.random.default_rng(0)
        offsets = self._random.uniform(-spread, spread, (num_envs, robot.dof))
        self.start = np.clip(robot.start + offsets, robot.lower, robot.upper)
        """Joint positions at the beginning (envs, dof) [rad or m]."""
        self.setpoint: Float64 = np.tile(robot.start, (num_envs, 1))
        """Setpoints (envs, dof) [rad or m]."""
        self._frames: deque[Rollout] = deque()
        self._runner = Runner(robot, num_envs, substeps=substeps, **options)
        self.ground = self._runner.options.ground
        """True if the scenes have a ground at height 0."""
        self._info = RunInfo.of(robot, ground=self.ground)
        self.reset()

    def set_setpoint(self, position: ArrayLike, *, joint: int | None = None) -> None:
        """Set setpoints [rad or m] of every robot: of one joint, or of all, (dof,) or (envs,
        dof).
        """
        joints = slice(None) if joint is None else joint
        self.setpoint[:, joints] = position
        self.setpoint = self.robot.coupling.positions(self.setpoint)

    def randomize_setpoints(self) -> None:
        """Draw a setpoint for each env, within the joint limits and 1 rad (or m) of the start
        pose.
        """
        drawn = self.robot.start + self._random.uniform(-1.0, 1.0, self.setpoint.shape)
        self.set_setpoint(np.clip(drawn, self.robot.lower, self.robot.upper))

    def reset(self) -> None:
        """Put every robot back to its start pose, at rest, with a reset controller."""
        first = self._frame(self._runner.reset(self.start), 0.0)
        # The page's thread reads the frames at any time: there is no moment without one.
        self._frames = deque([first], round(HISTORY_SECONDS / self.period))

    def advance(self) -> None:
        """Run one frame."""
        time = float(self._frames[-1].time[0])
        self._frames.append(self._frame(self._runner.step(self.setpoint), time + self.period))

    def frame(self) -> Rollout:
        """Return the present state, with the setpoints of the next frame, as a rollout of one
        tick.
        """
        return replace(self._frames[-1], setpoint=self.setpoint[None].copy())

    def history(self) -> Rollout:
        """Return the frames of the last :data:`HISTORY_SECONDS`, the present one included."""
        return Rollout.join(list(self._frames))

    def close(self) -> None:
        """Close the runner."""
        self._runner.close()

    def _frame(self, observation: Observation, time: float) -> Rollout:
        """Return an observation as a rollout of one tick."""
        row = observation.map(lambda array: array[None])
        return Rollout(
            np.array([time]),
            self.setpoint[None].copy(),
            row,
            self.period,
            self._info,
        )


class Playback:
    """Recorded run, from the first row to the last and then again.

    ``robot`` is by default :func:`recorded_robot`. Frames are ``period`` [s] apart, or a tick of
    the run.

    Raises
    ------
    InvalidArgumentError
        The run has no tick, more robots than fit on a page, or another number of joints than the
        robot; or the recording holds no robot.
    """

    def __init__(
        self, rollout: Rollout, robot: Robot | None = None, *, period: float = 1 / 30
    ) -> None:
        rollout.check_ticks()
        robot = recorded_robot(rollout) if robot is None else robot
        joints = rollout.qpos.shape[2]
        if joints != robot.dof:
            problem = f"has {joints} joints, robot {robot.name!r} has {robot.dof}"
            remedy = "give the robot that was recorded"
            raise InvalidArgumentError("rollout", problem, remedy=remedy)
        self.robot = robot
        self.num_envs = integer("num_envs", rollout.num_envs, 1, MAX_ROBOTS)
        ground = rollout.info.ground
        if ground is None:
            ground = robot.has_ground
        self.ground = ground
        """True if the run had a ground at height 0."""
        self._rollout = replace(rollout, time=rollout.time - rollout.time[0])
        self.duration = float(self._rollout.time[-1])
        """Time from the first row to the last [s]."""
        self.period = max(period, rollout.tick)
        self._now = 0.0

    def reset(self) -> None:
        """Go to the first row."""
        self._now = 0.0

    def advance(self) -> None:
        """Go to the next frame; after the last to the first."""
        ended = self._now >= self.duration
        self._now = 0.0 if ended else min(self._now + self.period, self.duration)

    def frame(self) -> Rollout:
        """Return the state recorded at the present time, as a rollout of one tick."""
        return self._since(self._now)

    def history(self) -> Rollout:
        """Return the rows up to the present one, of the last :data:`HISTORY_SECONDS`."""
        return self._since(self._now - HISTORY_SECONDS)

    def close(self) -> None:
        """Do nothing: a playback holds no resources."""

    def _since(self, start: float) -> Rollout:
        """Return the rows from a time [s] to the present one."""
        first, last = rows_at(self._rollout, np.array([start, self._now])).tolist()
        return self._rollout.for_ticks(first, last + 1)


ViewData = LiveSimulation | Playback


def recorded_robot(rollout: Rollout) -> Robot:
    """Return the robot of a run in this process, or the bundled one that was recorded, or the one
    in the recording; its meshes are read from their files, and left out where these are gone.

    Raises InvalidArgumentError if the recording has none.
    """
    info = rollout.info
    if isinstance(info.description, Robot):
        return info.description
    # Another robot may have the name of a bundled one.
    if info.robot in Robot.bundled():
        bundled = Robot.load(info.robot, fixed_base=info.fixed_base)
        if info.digest in (None, content(bundled)):
            return bundled
    if info.urdf is None:
        problem = f"{info.robot!r} is not bundled, and the recording holds no description of it"
        remedy = "name its URDF or MJCF file"
        raise InvalidArgumentError("robot", problem, remedy=remedy)
    with TemporaryDirectory(prefix="batchpid-") as folder:
        path = Path(folder, "robot.urdf")
        path.write_text(info.urdf, encoding="utf-8")
        return Robot.load(path, fixed_base=info.fixed_base)


def rows_at(rollout: Rollout, seconds: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the rows of ``rollout`` that are shown at times [s] since its first row."""
    elapsed = rollout.time - rollout.time[0]
    return np.searchsorted(elapsed, seconds - 1e-9).clip(0, len(elapsed) - 1)


def _plain(text: str) -> str:
    """Return ``text`` so that the page shows it as it is, where Markdown and HTML would be read."""
    return "".join(
        character if character.isalnum() or character == " " else f"&#{ord(character)};"
        for character in text
    )


class Panel:
    """Controls of ``data`` in a viser ``gui``. viser calls back from other threads: their requests
    are queued.
    """

    def __init__(self, gui: GuiApi, data: ViewData) -> None:
        self._gui = gui
        self._data = data
        self._requests: queue.SimpleQueue[Callable[[], object]] = queue.SimpleQueue()
        self.running = True
        """Whether frames follow each other, or the page is paused."""
        self._problem = ""
        self._status = gui.add_markdown("starting ...")
        self._connect(gui.add_button_group("Motion", ("Run", "Pause", "Reset")), self._control)
        self._speed = gui.add_slider("Speed", 0.1, 2.0, 0.1, 1.0)
        self._robot = gui.add_dropdown("Robot", [str(env) for env in range(data.num_envs)])
        self._joint = gui.add_dropdown("Joint", data.robot.joint_names)
        if isinstance(data, LiveSimulation):
            self._add_setpoints(data)

    @property
    def env(self) -> int:
        """Watched robot."""
        return int(self._robot.value)

    @property
    def joint(self) -> int:
        """Watched joint."""
        return self._data.robot.joint_names.index(self._joint.value)

    @property
    def speed(self) -> float:
        """Requested real-time factor."""
        return float(self._speed.value)

    def run_requests(self) -> bool:
        """Carry out the requests of the pages; return whether there were any. The status names one
        that failed.
        """
        count = self._requests.qsize()
        for _ in range(count):
            self._problem = ""
            try:
                self._requests.get()()
            except BatchPIDError as error:
                self._problem = _plain(str(error))
        return count > 0

    def update_status(self, frame: Rollout) -> None:
        """Show the time, and how many robots diverged or saturate."""
        data = self._data
        saturated = int(frame.saturated.any(-1).sum())
        diverged = int((~frame.ok).sum())
        lines = [
            f"**{data.num_envs} x {_plain(data.robot.name)}**",
            f"t = {frame.time[0]:.2f} s{'' if self.running else ', paused'}",
            f"{saturated} saturated, {diverged} diverged",
            self._problem,
        ]
        self._status.content = "  \n".join(lines)

    def _connect(self, handle: Any, action: Callable[[Any], object]) -> None:
        """Request ``action(value)`` whenever a page, and not this program, changes a control."""

        # A coroutine, so that the changes stay in order.
        async def changed(event: Any) -> None:
            if event.client is not None:
                self._requests.put(partial(action, handle.value))

        register = handle.on_click if hasattr(handle, "on_click") else handle.on_update
        register(changed)

    def _control(self, button: str) -> None:
        """Carry out a button of the motion."""
        if button == "Reset":
            self._data.reset()
        else:
            self.running = button == "Run"

    def _add_setpoints(self, live: LiveSimulation) -> None:
        """Add a slider for each joint, and buttons for poses."""
        gui = self._gui
        robot = live.robot
        sliders: dict[int, Any] = {}

        def go_to(pose: str) -> None:
            if pose == "random":
                live.randomize_setpoints()
            else:
                live.set_setpoint({"start": robot.start, "target": robot.target}[pose])
            for joint, slider in sliders.items():
                position = live.setpoint[self.env, joint]
                slider.value = float(np.clip(position, slider.min, slider.max))

        def move(joint: int, position: float) -> None:
            live.set_setpoint(position, joint=joint)

        self._connect(gui.add_button_group("Go to", ("start", "target", "random")), go_to)
        # Followers move with their leaders.
        for index in np.flatnonzero(robot.independent).tolist():
            joint = robot.joints[index]
            # Fewer digits to read, inside the limits.
            low = math.ceil(1e3 * max(joint.lower, -2 * math.pi)) / 1e3
            high = math.floor(1e3 * min(joint.upper, 2 * math.pi)) / 1e3
            value = float(np.clip(live.setpoint[0, index], low, high))
            slider = gui.add_slider(f"{joint.name} [{joint.unit}]", low, high, 1e-3, value)
            sliders[index] = slider
            self._connect(slider, partial(move, index))
