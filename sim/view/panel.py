"""The panel beside the robots: run and pause, what to watch, setpoints, gains, disturbances.

The page calls back from other threads. What it asks for is queued, and done between two frames.
"""

from __future__ import annotations

import math
import queue
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from sim.robot.robot import Robot
from sim.view.data import Frame, Source
from sim.view.playback import Playback
from sim.view.simulation import Live


class Panel:
    """The controls of ``source`` on ``server``; :meth:`work` does what was asked for since the last call."""

    def __init__(self, server: Any, source: Source) -> None:
        self._gui, self._source = server.gui, source
        self._asked: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self.playing = True
        self.steps = 0
        """Frames still to run while paused."""
        self._names = short_names(source.robot)
        gui = self._gui
        self._status = gui.add_markdown("starting ...")
        self._run = gui.add_button_group("Motion", ("Run", "Pause", "Step", "Reset"))
        self._on(self._run, self._pressed)
        self._speed = gui.add_slider("Speed", min=0.1, max=2.0, step=0.1, initial_value=1.0)
        if isinstance(source, Playback):
            self._place = gui.add_slider("Time [s]", 0.0, source.duration, source.period, 0.0)
            self._on(self._place, source.seek)
        with gui.add_folder("Watch"):
            self._robot = gui.add_slider("Robot", min=0, max=max(1, source.per_group - 1), step=1, initial_value=0)
            self._robot.disabled = source.per_group == 1
            self._joint = gui.add_dropdown("Joint", self._names, initial_value=self._names[_first_moving(source.robot)])
            self._ghost = gui.add_checkbox("Show its setpoint", True)
        if isinstance(source, Live):
            self._live(source)

    @property
    def env(self) -> int:
        """The robot of each group that is watched."""
        return min(int(self._robot.value), self._source.per_group - 1)

    @property
    def joint(self) -> int:
        """The joint that is watched."""
        return self._names.index(self._joint.value)

    @property
    def ghost(self) -> bool:
        """Whether the watched robot's setpoint is shown."""
        return bool(self._ghost.value)

    @property
    def speed(self) -> float:
        """Simulated seconds a second."""
        return float(self._speed.value)

    def select(self, robot: int) -> None:
        """Watch a robot; called when it is clicked."""
        self._robot.value = robot % self._source.per_group

    def work(self) -> None:
        """Do what was asked for since the last call."""
        while True:
            try:
                job = self._asked.get_nowait()
            except queue.Empty:
                return
            job()

    def tell(self, frame: Frame, factor: float, rate: float) -> None:
        """Show time, speed and what is wrong."""
        source = self._source
        lines = [
            f"**{source.per_group} x {source.robot.name}** · {' beside '.join(source.groups)}",
            f"t = {frame.time:.2f} s · "
            + (f"{factor:.2f} x real time · {rate:.0f} frames/s" if self.playing else "paused"),
        ]
        dead, strained = int((~frame.ok).sum()), int(frame.saturated.sum())
        if dead:
            lines.append(f"**{dead} diverged** (red): these gains are unstable; Reset brings them back")
        lines.append(f"{strained} of {len(frame.ok)} saturated" if strained else "no effort at its limit")
        self._status.content = "  \n".join(lines)
        if isinstance(source, Playback):
            self._place.value = frame.time

    # -- inside ----------------------------------------------------------------------------------------------------

    def _on(self, handle: Any, do: Callable[[Any], None]) -> None:
        """Queue ``do(value)`` when the page (and not this program) changes a control."""

        def changed(event: Any) -> None:
            if event.client is not None:
                self._asked.put(partial(do, handle.value))

        (handle.on_click if hasattr(handle, "on_click") else handle.on_update)(changed)

    def _pressed(self, button: str) -> None:
        if button == "Step":
            self.playing, self.steps = False, self.steps + 1
        elif button == "Reset":
            self._source.reset()
        else:
            self.playing = button == "Run"

    def _live(self, live: Live) -> None:
        tabs = self._gui.add_tab_group()
        with tabs.add_tab("Setpoint"):
            self._setpoints(live)
        with tabs.add_tab("Gains"):
            self._gains(live)
        with tabs.add_tab("Disturb"):
            self._disturbances(live)

    def _setpoints(self, live: Live) -> None:
        gui, robot = self._gui, live.robot
        poses = {"start": robot.start} | ({} if robot.settings is None else {"target": robot.settings.target})
        go = gui.add_button_group("Go to", (*poses, "random"))
        only = gui.add_checkbox("Watched robot only", False)
        sliders: list[Any] = []

        def env() -> int | None:
            return self.env if only.value else None

        def show() -> None:
            for slider, value in zip(sliders, live.setpoint[self.env], strict=True):
                slider.value = float(np.clip(value, slider.min, slider.max))

        def pressed(name: str) -> None:
            if name == "random":
                live.go_anywhere()
            else:
                live.go_to(poses[name])
            show()

        def go_one(joint: int, position: float) -> None:
            live.go(joint, position, env())

        self._on(go, pressed)
        for index, (name, joint) in enumerate(zip(self._names, robot.joints, strict=True)):
            low, high = max(joint.lower, -2 * math.pi), min(joint.upper, 2 * math.pi)
            low, high = math.ceil(1e3 * low) / 1e3, math.floor(1e3 * high) / 1e3  # fewer digits to read
            value = float(np.clip(live.setpoint[0, index], low, high))
            slider = gui.add_slider(f"{name} [{joint.unit}]", low, high, min(_step(high - low), 0.01), value)
            self._on(slider, partial(go_one, index))
            sliders.append(slider)
        self._robot.on_update(lambda _: self._asked.put(show))

    def _gains(self, live: Live) -> None:
        gui = self._gui
        control = gui.add_dropdown("Of", live.groups) if len(live.groups) > 1 else None
        says = gui.add_markdown("")
        rows: dict[str, tuple[Any, float]] = {}

        def group() -> str:
            return live.groups[0] if control is None else str(control.value)

        def change(gain: str, factor: float, value: float) -> None:
            live.tune(group(), gain, self.joint, value / factor)

        for gain, label, factor in (
            ("kp", "kp", 1.0),
            ("ki", "ki", 1.0),
            ("kd", "kd", 1.0),
            ("derivative_filter_time", "filter [ms]", 1e3),
            ("setpoint_weight", "setpoint weight", 1.0),
            ("effort_limit", "effort limit", 1.0),
        ):
            slider = gui.add_slider(label, 0.0, 1.0, 0.01, 0.0)
            rows[gain] = (slider, factor)
            self._on(slider, partial(change, gain, factor))
        names = tuple(dict.fromkeys(name for each in live.groups for name in live.gain_sets(each)))
        back = gui.add_button_group("All joints to", names)

        def show(_: Any = None) -> None:
            joint = live.robot.joints[self.joint]
            of_joint = f"Of **{self._names[self.joint]}**, on every robot"
            says.content = f"{of_joint}. {_gain_units(live, group(), joint.unit, joint.effort_unit)}"
            for gain, (slider, factor) in rows.items():
                value, top = (_short(factor * n) for n in live.gain_range(group(), gain, self.joint))
                slider.max, slider.step = max(value, top), _step(top)
                slider.value = value

        def restore(name: str) -> None:
            if name in live.gain_sets(group()):
                live.take_gains(group(), name)
                show()

        self._on(back, restore)
        for chooser in (self._joint, control):
            if chooser is not None:
                chooser.on_update(lambda _: self._asked.put(show))
        show()

    def _disturbances(self, live: Live) -> None:
        gui, links = self._gui, live.kinematics.links
        where = gui.add_dropdown("On link", links, initial_value=links[live.load_link])
        weight = gui.add_slider("Payload [kg]", 0.0, 5.0, 0.1, 0.0)
        force = gui.add_slider("Push [N]", 0.0, 200.0, 5.0, 60.0)
        push = gui.add_button_group("Push along", ("+x", "-x", "+y", "-y", "up", "down"))
        directions = dict(zip(("+x", "-x", "+y", "-y", "up", "down"), np.repeat(np.eye(3), 2, axis=0), strict=True))
        for name in ("-x", "-y", "down"):
            directions[name] = -directions[name]

        def hang(value: float) -> None:
            live.payload = value

        def move(link: str) -> None:
            live.load_link = live.kinematics.index(link)

        self._on(where, move)
        self._on(weight, hang)
        self._on(push, lambda name: live.push(tuple(float(force.value) * directions[name])))


def short_names(robot: Robot) -> tuple[str, ...]:
    """Return the joint names without the words that all of them begin with; a bare number keeps the word before."""
    words = [name.split("_") for name in robot.joint_names]
    first, last = min(words), max(words)  # what these two share, all share
    shared = next((k for k, (a, b) in enumerate(zip(first, last, strict=False)) if a != b), 0)
    return tuple("_".join(each[shared - (shared > 0 and each[shared].isdigit()) :]) for each in words)


def _first_moving(robot: Robot) -> int:
    """Return the joint that the tutorial moves farthest, to begin with."""
    return 0 if robot.settings is None else int(np.argmax(np.abs(robot.settings.target - robot.start)))


def _gain_units(live: Live, control: str, position: str, effort: str) -> str:
    """Return the units of kp, ki and kd, in words."""
    if control == "pid" and live.gain_units != "effort":
        return "kp in 1/s², ki in 1/s³, kd in 1/s, times the inertia."
    return f"kp in {effort}/{position}, ki in {effort}/({position} s), kd in {effort} s/{position}."


def _short(value: float) -> float:
    """Return a number of four digits to show: the box beside a slider holds no more."""
    return float(f"{value:.4g}")


def _step(width: float) -> float:
    """Return a slider's step: a power of ten that makes some hundred steps or more of the width."""
    return 10.0 ** math.floor(math.log10(max(width, 1e-9) / 100))
