"""Controls of the page: motion, the watched joint, setpoints. Requests are carried out
between two frames.
"""

from __future__ import annotations

import math
import queue
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from batchpid.errors import BatchPIDError
from batchpid.sim.rollout import Rollout
from batchpid.sim.view.view_data import LiveSimulation, ViewData

if TYPE_CHECKING:
    from viser import GuiApi


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
        self.frames_left = math.inf
        """Frames to run before the next pause."""
        self._problem = ""
        self._status = gui.add_markdown("starting ...")
        buttons = gui.add_button_group("Motion", ("Run", "Pause", "Step", "Reset"))
        self._connect(buttons, self._control_motion)
        self._speed = gui.add_slider("Speed", 0.1, 2.0, 0.1, 1.0)
        # The watched robot and joint; a change shows at the next frame.
        self._robot = gui.add_slider("Robot", 0, max(1, data.num_envs - 1), 1, 0)
        self._robot.disabled = data.num_envs == 1
        self._connect(self._robot, lambda _: None)
        self._joint = gui.add_dropdown("Joint", data.robot.joint_names)
        self._connect(self._joint, lambda _: None)
        if isinstance(data, LiveSimulation):
            self._add_setpoints(data)

    @property
    def env(self) -> int:
        """Watched robot."""
        return min(int(self._robot.value), self._data.num_envs - 1)

    @property
    def joint(self) -> int:
        """Watched joint."""
        return self._data.robot.joint_names.index(self._joint.value)

    @property
    def speed(self) -> float:
        """Requested real-time factor."""
        return float(self._speed.value)

    def select(self, robot: int) -> None:
        """Request to watch a robot. Safe to call from any thread."""
        self._requests.put(partial(setattr, self._robot, "value", robot))

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

    def update_status(self, frame: Rollout, rate: float) -> None:
        """Show time, real-time factor, frame ``rate`` [1/s], and how many robots diverged or
        saturate.
        """
        data = self._data
        time = float(frame.time[0])
        factor = rate * data.period
        pace = f"t = {time:.2f} s · {factor:.2f} x real time · {rate:.0f} frames/s"
        saturated = int(frame.saturated.any(-1).sum())
        diverged = int((~frame.ok).sum())
        lines = [
            f"**{data.num_envs} x {_plain(data.robot.name)}**",
            pace if self.frames_left else "paused",
            f"{saturated} saturated, {diverged} diverged",
            self._problem,
        ]
        self._status.content = "  \n".join(lines)

    def _connect(self, handle: Any, action: Callable[[Any], object]) -> Any:
        """Request ``action(value)`` whenever a page, and not this program, changes a control;
        return its handle.
        """

        # A coroutine, so that the changes stay in order.
        async def changed(event: Any) -> None:
            if event.client is not None:
                self._requests.put(partial(action, handle.value))

        if hasattr(handle, "on_click"):
            register = handle.on_click
        else:
            register = handle.on_update
        register(changed)
        return handle

    def _control_motion(self, button: str) -> None:
        """Carry out a button of the motion."""
        if button == "Reset":
            self._data.reset()
        else:
            self.frames_left = {"Run": math.inf, "Pause": 0, "Step": 1}[button]

    def _add_setpoints(self, live: LiveSimulation) -> None:
        """Add a slider for each joint, and buttons for poses."""
        gui = self._gui
        robot = live.robot
        poses = {"start": robot.start, "target": robot.target}
        sliders: dict[int, Any] = {}

        def go_to(pose: str) -> None:
            if pose == "random":
                live.randomize_setpoints()
            else:
                live.set_setpoint(poses[pose])
            for joint, slider in sliders.items():
                position = live.setpoint[self.env, joint]
                slider.value = float(np.clip(position, slider.min, slider.max))

        def move(joint: int, position: float) -> None:
            live.set_setpoint(position, joint=joint)

        self._connect(gui.add_button_group("Go to", (*poses, "random")), go_to)
        # Followers move with their leaders.
        for index in np.flatnonzero(robot.independent).tolist():
            joint = robot.joints[index]
            # Fewer digits to read, inside the limits.
            low = math.ceil(1e3 * max(joint.lower, -2 * math.pi)) / 1e3
            high = math.floor(1e3 * min(joint.upper, 2 * math.pi)) / 1e3
            value = float(np.clip(live.setpoint[0, index], low, high))
            slider = gui.add_slider(f"{joint.name} [{joint.unit}]", low, high, 1e-3, value)
            sliders[index] = self._connect(slider, partial(move, index))
