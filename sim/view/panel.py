"""Control panel of the page: motion, the watched joint, setpoints, gains, disturbances, and queued requests.

viser calls back from a separate thread, with unchecked data from a page. A control keeps its last valid value. Requests
of controls are queued and executed between two frames.
"""

from __future__ import annotations

import html
import math
import queue
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.checks.validate import choice, flag, integer, number
from batchpid.errors import BatchPIDError, InvalidArgumentError
from batchpid.sim.command import CommandSpec
from batchpid.sim.observation import Rollout
from batchpid.sim.robot.robot import Robot
from batchpid.sim.robot.unsettled import unsettled_findings
from batchpid.sim.view.gains import GAINS
from batchpid.sim.view.playback import Playback
from batchpid.sim.view.simulation import LiveSimulation

MAX_REQUESTS = 256
"""Largest number of requests between two frames."""


class Requests:
    """Queue of requests from the pages. ``refuse`` is called with the reason for every request that fails."""

    def __init__(self, refuse: Callable[[str], object]) -> None:
        self.refuse = refuse
        self._queue: queue.Queue[Callable[[], object]] = queue.Queue(MAX_REQUESTS)

    def put(self, request: Callable[[], object]) -> None:
        """Queue a request. Safe to call from any thread."""
        try:
            self._queue.put_nowait(request)
        except queue.Full:
            self.refuse(f"more than {MAX_REQUESTS} requests in a frame; slow down")

    def run(self) -> None:
        """Carry out the requests that are queued now."""
        for _ in range(self._queue.qsize()):
            try:
                self._queue.get_nowait()()
            except BatchPIDError as error:
                self.refuse(str(error))


class Control:
    """Slider, drop-down, checkbox or group of buttons: a ``handle`` of viser, and its last valid value."""

    def __init__(self, handle: Any, requests: Requests) -> None:
        self.handle = handle
        """Handle of viser, for everything but the value."""
        self._value, self._requests = handle.value, requests
        self._actions: list[Callable[[Any], object]] = []
        (handle.on_click if hasattr(handle, "on_click") else handle.on_update)(self._changed)

    @property
    def value(self) -> Any:
        """Last valid value. Setting it shows it on every page."""
        return self._value

    @value.setter
    def value(self, value: Any) -> None:
        self._value = self.handle.value = value

    def on_change(self, action: Callable[[Any], object]) -> Control:
        """Request ``action(value)`` whenever a page, and not this program, changes the control."""
        self._actions.append(action)
        return self

    def change(self, value: Any) -> None:
        """Set the value and carry out the actions, between two frames."""
        self.value = value
        for action in self._actions:
            action(value)

    async def _changed(self, event: Any) -> None:
        if event.client is None:
            return
        try:
            self._value = _checked(self.handle)
        except InvalidArgumentError as error:
            self._requests.refuse(str(error))
            self.handle.value = self._value
            return
        for action in self._actions:
            self._requests.put(partial(action, self._value))


def _checked(handle: Any) -> Any:
    """Return the value of a control if it is one that the control offers."""
    if hasattr(handle, "options"):
        return choice(handle.label, handle.value, handle.options)
    if hasattr(handle, "max"):
        return number(handle.label, handle.value, handle.min, handle.max, "as on the slider")
    return flag(handle.label, handle.value)


ViewData = LiveSimulation | Playback
PATIENCE = 2.0
"""Time after a change of the setpoint from which a robot should have settled [s]."""


def cause(data: ViewData, robot: int) -> str:
    """Return a sentence with the reason why a robot, numbered over all groups, has not settled since its last setpoint.

    Empty if it has, or within :data:`PATIENCE`.
    """
    past = data.history().for_envs([robot])
    changes = np.flatnonzero((past.setpoint != past.setpoint[-1]).any((1, 2)))
    since = past.for_ticks(slice(int(changes[-1]) + 1 if changes.size else 0, None))
    if len(since.time) < 3 or since.time[-1] - since.time[0] < PATIENCE:
        return ""
    since = replace(since, info=replace(data.info_of(robot), start=since.qpos[0].astype(float)))
    return next((str(found).partition(": ")[2] for found in unsettled_findings(since, data.robot)), "")


_DIRECTIONS = dict(zip(("+x", "+y", "up", "-x", "-y", "down"), np.concatenate([np.eye(3), -np.eye(3)]), strict=True))
_FINDING_STYLE = "margin: 0.5em 1em; font-size: 0.8em; color: #b45309; overflow-wrap: anywhere"
_ENTRY_STYLE = "margin: 0.5em 1em; font-size: 0.8em; overflow-wrap: anywhere"
_MILLISECONDS = {"derivative_filter_time": 1e3}
"""Factor from a gain to the number on its slider, where that is not 1."""


class Panel:
    """Controls of ``data`` on a viser ``server``, under the sentences in ``findings``.

    ``refuse`` is called with the reason for every request that fails.
    """

    def __init__(
        self, server: Any, data: ViewData, refuse: Callable[[str], object], findings: Sequence[str] = ()
    ) -> None:
        self._gui, self._data = server.gui, data
        self.requests = Requests(refuse)
        """Requests of the page, which are carried out between two frames."""
        self.only_watched = True
        """True if a target applies to the watched robot alone."""
        self.frames_left = math.inf
        """Frames to run before the next pause."""
        self._names = short_names(data.robot)
        gui = self._gui
        self._status, self._cause = gui.add_markdown("starting ..."), gui.add_html("")
        for finding in findings:  # names from files are text, not markup
            gui.add_html(f'<p style="{_FINDING_STYLE}">{html.escape(finding)}</p>')
        motion = gui.add_button_group("Motion", ("Run", "Pause", "Step", "Reset"))
        self._control(motion).on_change(self._control_motion)
        self._speed = self._control(gui.add_slider("Speed", min=0.1, max=2.0, step=0.1, initial_value=1.0))
        if isinstance(data, Playback):
            time = gui.add_slider("Time [s]", 0.0, data.duration, data.period, 0.0)
            self._time = self._control(time).on_change(data.seek)
        with gui.add_folder("Watch"):
            robot = gui.add_slider("Robot", min=0, max=max(1, data.per_group - 1), step=1, initial_value=0)
            robot.disabled = data.per_group == 1
            self._robot = self._control(robot)
            # At first the joint that moves farthest to the target.
            settings = data.robot.settings
            first = 0 if settings is None else int(np.argmax(np.abs(settings.target - data.robot.start)))
            self._joint = self._control(gui.add_dropdown("Joint", self._names, initial_value=self._names[first]))
            checkbox = gui.add_checkbox("Show its setpoint", True)
            self._show_setpoint = self._control(checkbox)
            checkbox.visible = data.frame().info.sets_positions
            self._entries = None if checkbox.visible else gui.add_html("")  # numbers of a setpoint that is not a pose
        if isinstance(data, LiveSimulation):
            tabs = gui.add_tab_group()
            adders = {"Setpoint": self._add_setpoints, "Gains": self._add_gains, "Disturb": self._add_disturbances}
            if data.command is not None:
                adders = {"Target": self._add_target, "Disturb": self._add_disturbances}
            for title, add in adders.items():
                with tabs.add_tab(title):
                    add(data)

    @property
    def env(self) -> int:
        """Watched robot of each group."""
        return min(int(self._robot.value), self._data.per_group - 1)

    @property
    def joint(self) -> int:
        """Watched joint."""
        return self._names.index(self._joint.value)

    @property
    def show_setpoint(self) -> bool:
        """True while the setpoint of the watched robot is shown."""
        return bool(self._show_setpoint.value)

    @property
    def speed(self) -> float:
        """Requested real-time factor."""
        return float(self._speed.value)

    def select(self, robot: Any) -> None:
        """Request to watch a robot, by its number over all groups. Safe to call from any thread."""
        try:
            robot = integer("robot", robot, 0, len(self._data.groups) * self._data.per_group - 1)
        except InvalidArgumentError as error:
            self.requests.refuse(str(error))
        else:
            self.requests.put(partial(self._robot.change, robot % self._data.per_group))

    def update_status(self, frame: Rollout, factor: float, rate: float) -> None:
        """Show time, real-time factor, frame rate, and the robots that diverged or saturate."""
        data, time = self._data, float(frame.time[0])
        diverged, saturated = int((~frame.ok).sum()), int(frame.saturated.any(-1).sum())
        speed = f"{factor:.2f} x real time · {rate:.0f} frames/s" if self.frames_left else "paused"
        lines = [
            f"**{data.per_group} x {data.robot.name}** · {' and '.join(data.groups)}",
            f"t = {time:.2f} s · {speed}",
            f"{saturated} of {frame.num_envs} saturated" if saturated else "no effort at its limit",
        ]
        if diverged:
            lines.insert(2, f"**{diverged} diverged** (red): these gains are unstable; Reset brings them back")
        self._status.content = "  \n".join(lines)
        if isinstance(data, Playback):
            self._time.value = time
        of_group = [(group, cause(data, k * data.per_group + self.env)) for k, group in enumerate(data.groups)]
        found = [f"{group}: {text}" if len(data.groups) > 1 else text for group, text in of_group if text]
        text = f"Robot {self.env} has not settled. {' '.join(found)}" if found else ""
        self._cause.content = f'<p style="{_FINDING_STYLE}">{html.escape(text)}</p>' if text else ""
        if self._entries is not None:
            numbers = _numbers(frame.info.command, frame.setpoint[0, self.env])
            self._entries.content = f'<p style="{_ENTRY_STYLE}">{html.escape(f"setpoint: {numbers}")}</p>'

    def _control(self, handle: Any) -> Control:
        return Control(handle, self.requests)

    def _control_motion(self, button: str) -> None:
        if button == "Reset":
            self._data.reset()
        elif button == "Step":
            self.frames_left = 1 if math.isinf(self.frames_left) else self.frames_left + 1
        else:
            self.frames_left = math.inf if button == "Run" else 0

    def _add_setpoints(self, live: LiveSimulation) -> None:
        gui, robot = self._gui, live.robot
        poses = {"start": robot.start} | ({} if robot.settings is None else {"target": robot.settings.target})
        buttons = self._control(gui.add_button_group("Go to", (*poses, "random")))
        watched_only = self._control(gui.add_checkbox("Watched robot only", False))
        sliders: dict[int, Control] = {}

        def update(*_: object) -> None:
            for index, slider in sliders.items():
                value = live.setpoint[self.env, index]
                slider.value = float(np.clip(value, slider.handle.min, slider.handle.max))

        def go_to(pose: str) -> None:
            if pose == "random":
                live.randomize_setpoints()
            else:
                live.set_setpoint(poses[pose])
            update()

        def move(joint: int, position: float) -> None:
            live.set_setpoint(position, joint=joint, env=self.env if watched_only.value else None)

        buttons.on_change(go_to)
        for index in np.flatnonzero(robot.independent).tolist():  # followers move with their leaders
            name, joint = self._names[index], robot.joints[index]
            low, high = max(joint.lower, -2 * math.pi), min(joint.upper, 2 * math.pi)
            low, high = math.ceil(1e3 * low) / 1e3, math.floor(1e3 * high) / 1e3  # fewer digits to read
            value = float(np.clip(live.setpoint[0, index], low, high))
            slider = gui.add_slider(f"{name} [{joint.unit}]", low, high, min(_slider_step(high - low), 0.01), value)
            sliders[index] = self._control(slider).on_change(partial(move, index))
        self._robot.on_change(update)

    def _add_target(self, live: LiveSimulation) -> None:
        gui = self._gui
        gui.add_markdown("Drag the frame at the tool: arrows move, arcs turn its target.")
        self._control(gui.add_checkbox("Watched robot only", True)).on_change(partial(setattr, self, "only_watched"))
        back = self._control(gui.add_button_group("Go to", ("start",)))
        back.on_change(lambda _: live.set_target(live.neutral, env=self.env if self.only_watched else None))

    def _add_gains(self, live: LiveSimulation) -> None:
        gui = self._gui
        group = self._control(gui.add_dropdown("Of", live.groups))
        group.handle.visible = len(live.groups) > 1
        description = gui.add_markdown("")
        sliders: dict[str, Control] = {}

        def change(gain: str, number: float) -> None:
            live.gains[group.value].set(gain, self.joint, number / _MILLISECONDS.get(gain, 1.0))

        for gain in GAINS:
            label = "filter [ms]" if gain in _MILLISECONDS else gain.replace("_", " ")
            sliders[gain] = self._control(gui.add_slider(label, 0.0, 1.0, 0.01, 0.0)).on_change(partial(change, gain))
        names = dict.fromkeys(name for gains in live.gains.values() for name in gains.sets)
        buttons = self._control(gui.add_button_group("All joints to", tuple(names)))

        def update(*_: object) -> None:
            joint, gains = live.robot.joints[self.joint], live.gains[group.value]
            effort, position = joint.effort_unit, joint.unit
            units = f"kp in {effort}/{position}, ki in {effort}/({position} s), kd in {effort} s/{position}."
            if gains.params.gain_units is not None:
                units = "kp in 1/s², ki in 1/s³, kd in 1/s, times the inertia."
            description.content = f"Of **{self._names[self.joint]}**, on every robot. {units}"
            for gain, slider in sliders.items():
                # Four digits: the box next to a slider holds no more.
                value, high = (
                    float(f"{_MILLISECONDS.get(gain, 1.0) * n:.4g}") for n in gains.slider_range(gain, self.joint)
                )
                slider.handle.max, slider.handle.step, slider.value = max(value, high), _slider_step(high), value

        def apply(name: str) -> None:
            if name in live.gains[group.value].sets:
                live.gains[group.value].apply_set(name)
                update()

        buttons.on_change(apply)
        for chooser in (self._joint, group):
            chooser.on_change(update)
        update()

    def _add_disturbances(self, live: LiveSimulation) -> None:
        gui, links = self._gui, live.robot.rigid_tree.links
        link = self._control(gui.add_dropdown("On link", links, initial_value=live.load_link))
        link.on_change(lambda name: setattr(live, "load_link", name))
        payload = self._control(gui.add_slider("Payload [kg]", 0.0, 5.0, 0.1, 0.0))
        payload.on_change(partial(setattr, live, "payload"))
        force = self._control(gui.add_slider("Push [N]", 0.0, 200.0, 5.0, 60.0))
        push = self._control(gui.add_button_group("Push along", tuple(_DIRECTIONS)))
        push.on_change(lambda name: live.push(force.value * _DIRECTIONS[name]))


def short_names(robot: Robot) -> tuple[str, ...]:
    """Return the joint names without the words that all of them begin with; a bare number keeps the word before."""
    words = [name.split("_") for name in robot.joint_names]
    first, last = min(words), max(words)  # their common start is the common start of all names
    shared = next((k for k, (a, b) in enumerate(zip(first, last, strict=False)) if a != b), 0)
    return tuple("_".join(each[shared - (shared > 0 and each[shared].isdigit()) :]) for each in words)


def _numbers(command: CommandSpec, setpoint: NDArray[np.float64]) -> str:
    """Return a setpoint (size,) as text: names, numbers and units."""
    columns = zip(command.names, setpoint.tolist(), command.units, strict=True)
    return ", ".join(f"{name} {value:.4g} {unit}".rstrip() for name, value, unit in columns)


def _slider_step(width: float) -> float:
    """Return a power of ten that divides ``width`` into a hundred steps or more."""
    return 10.0 ** math.floor(math.log10(max(width, 1e-9) / 100))
