"""Page that shows robots: charts of a joint, a frame at the tool, and the loop that keeps real time."""

from __future__ import annotations

import io
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, redirect_stdout, suppress
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Document
from batchpid.checks.single_owner import SingleOwner
from batchpid.errors import MissingDependencyError
from batchpid.sim.observation import Rollout
from batchpid.sim.robot.findings import summary
from batchpid.sim.view.panel import Panel, ViewData
from batchpid.sim.view.playback import HISTORY_SECONDS
from batchpid.sim.view.scene import RobotScene
from batchpid.sim.view.simulation import LiveSimulation

CHARTS_EVERY = 5
"""Frames between two updates of the charts."""
STATUS_EVERY = 15
"""Frames between two updates of the status."""
NOTICE_SECONDS = 1.0
"""Shortest time between two notices of refused messages [s]."""


class View(SingleOwner, AbstractContextManager["View"]):
    """Page that shows ``data``, served at ``host`` and ``port``, or at the next free port, until :meth:`close`.

    Only somebody who knows :attr:`url` can open it. Messages of a page are checked; refusals are shown on the pages.

    Raises
    ------
    InvalidArgumentError
        The host is not an address of this machine, or no port is free.
    MissingDependencyError
        The package ``viser`` is missing.
    """

    def __init__(self, data: ViewData, *, host: str = "127.0.0.1", port: int = 8080) -> None:
        try:
            import viser

            from batchpid.sim.view.gate import Gate  # needs what viser needs
        except ImportError:
            raise MissingDependencyError("viser", "the browser view", "view") from None
        self.data = data
        self._problems: deque[str] = deque(maxlen=1)
        self._gate = gate = Gate(host, port, self._problems.append)
        with redirect_stdout(io.StringIO()):  # viser's banner
            make = partial(viser.ViserServer, host=host, port=gate.port, verbose=False, label="batchpid")
            self._server: Any = gate.start(make)
        self.url = gate.url
        """Address of the page, with the token that opens it."""
        self.port = gate.port
        """Port of the page."""
        self.rate, self.factor = 0.0, 0.0
        """Frames per second of wall time, and real-time factor."""
        gui = self._server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(43, 92, 199))
        self._scene = RobotScene(self._server, data.robot, data.groups, data.per_group, data.ground)
        self.findings = summary(self._scene.findings)
        """Sentences on meshes that cannot be read, which the page shows as well."""
        self.panel = Panel(self._server, data, self._problems.append, self.findings)
        self._scene.on_click(self.panel.select)
        self._gizmo: TargetGizmo | None = None
        if isinstance(data, LiveSimulation) and data.command is not None:
            layout, panel = self._scene.layout, self.panel
            self._gizmo = TargetGizmo(
                self._server, data, layout.positions, layout.reach, panel.requests.put, lambda: panel.only_watched
            )
        gui.main_panel.dock_right()
        gui.main_panel.set_width(330)
        charts = gui.add_panel()
        with charts.add_tab("Charts"):
            self._charts = Charts(gui, data)
        charts.dock_left()
        charts.set_width(380)
        self._stopped = self._settled = False
        self._noticed = 0.0
        self._shown: tuple[Any, ...] = ()

    def run(self, seconds: float | None = None) -> None:
        """Serve the page for ``seconds`` of wall time, or until :meth:`stop` or Ctrl-C."""
        data, panel = self.data, self.panel
        began = deadline = time.monotonic()
        laps: deque[tuple[float, float]] = deque([(began, data.frame().time[0])], maxlen=45)
        count = 0
        with ThreadPoolExecutor(1) as executor:
            while not self._stopped and (seconds is None or time.monotonic() - began < seconds):
                panel.requests.run()
                frame = data.frame()
                # The workers compute the next frame while this one is sent.
                job = executor.submit(data.advance) if panel.frames_left > 0 else None
                panel.frames_left = max(0, panel.frames_left - 1)
                if clients := self._server.get_clients():
                    self._show(frame, count)
                    self._notify(list(clients.values()))
                if job is not None:
                    job.result()
                now = time.monotonic()
                laps.append((now, data.frame().time[0]))
                (first, start), (last, end) = laps[0], laps[-1]
                if last > first:
                    self.rate = (len(laps) - 1) / (last - first)
                    self.factor = max(0.0, end - start) / (last - first)
                count += 1
                # A late frame is not caught up, which would only hurry the next ones.
                deadline = max(deadline + data.period / panel.speed, now)
                time.sleep(deadline - now)

    def stop(self) -> None:
        """Make :meth:`run` return after the present frame. Safe to call from any thread."""
        self._stopped = True

    def close(self) -> None:
        """Close the page and its data."""
        self.stop()
        self.data.close()
        self._gate.close()
        # After a browser has connected, viser takes about 5 s to end its threads. They are daemons: do not wait.
        thread = threading.Thread(target=self._server.stop, daemon=True)
        with redirect_stdout(io.StringIO()):
            thread.start()
            thread.join(timeout=0.5)

    def __exit__(self, *_: object) -> None:
        self.close()

    def _notify(self, clients: list[Any]) -> None:
        """Show the last problem on every page, at intervals: strangers must not flood them."""
        if self._problems and time.monotonic() - self._noticed > NOTICE_SECONDS:
            self._noticed, problem = time.monotonic(), self._problems.pop()[:300]
            for client in clients:
                with suppress(UserWarning):  # the page is closed by now, and warnings are errors
                    client.add_notification("Not accepted", problem, auto_close_seconds=8.0, color="red")

    def _show(self, frame: Rollout, count: int) -> None:
        """Send changes: charts and status at intervals, and once more when the robots come to rest."""
        panel = self.panel
        watched = (panel.env, panel.joint, panel.show_setpoint)
        shown = (frame.qpos.tobytes(), frame.setpoint.tobytes(), frame.time[0], *watched)
        settled = shown == self._shown
        settling = settled and not self._settled
        self._shown, self._settled = shown, settled
        if not settled:
            self._scene.update(frame, panel.env, panel.show_setpoint)
        if self._gizmo is not None:
            self._gizmo.update(panel.env)
        if settling or (not settled and count % CHARTS_EVERY == 0):
            self._charts.update(panel.env, panel.joint)
        if settling or (not settled and count % STATUS_EVERY == 0):
            panel.update_status(frame, self.factor, self.rate)


_COLOURS = ("#15803d", "#d97706")
"""Colour of each group's curves."""
_LIMIT_RATIO = 4.0
"""A limit is drawn where it is less than this many times the largest effort."""
_MIN_RANGE = {"min": -0.012, "max": 0.012}
"""Smallest range of a vertical axis [rad, m, N m or N]: noise alone should not fill a chart."""
_SCALES = {
    "x": {"time": False, "range": (-HISTORY_SECONDS, 0.0)},  # without a fixed range the axis drifts in viser 1.1
    "y": {"range": {end: {"pad": 0.1, "soft": soft, "mode": 1} for end, soft in _MIN_RANGE.items()}},
}


class Charts:
    """Three charts in ``gui``, of one joint of the same robot in every group."""

    def __init__(self, gui: Any, data: ViewData) -> None:
        self._data = data
        names = data.groups if len(data.groups) > 1 else ("",)

        def chart(title: str, *series: Document) -> Any:
            return gui.add_uplot(
                (np.array([-HISTORY_SECONDS, 0.0]), *[np.zeros(2)] * len(series)),  # flat until the first update
                ({"label": "s"}, *series),
                title=title,
                scales=_SCALES,
                legend={"show": True, "live": False},
                height=168,
                axes=({"size": 30, "stroke": "#6b7280"}, {"size": 56, "stroke": "#6b7280"}),
                padding=(4, 14, 0, 0),
            )

        def curves(quantity: str) -> list[Document]:
            return [
                {"label": f"{quantity} {name}".strip(), "stroke": colour, "width": 2}
                for name, colour in zip(names, _COLOURS, strict=False)
            ]

        dashed = {"width": 1, "dash": [6, 4]}
        limits = ({"label": f"{end} limit", "stroke": "#b6bcc6", **dashed} for end in ("lower", "upper"))
        self._sets_positions = data.frame().info.sets_positions
        target = [{"label": "setpoint", "stroke": "#4a82ff", **dashed}] if self._sets_positions else []
        self._position = chart("position", *curves("qpos"), *target)
        self._error = chart("error", *curves("error"))
        self._error.visible = self._sets_positions
        self._effort = chart("effort", *limits, *curves("effort"))

    def update(self, env: int, joint: int) -> None:
        """Draw the recent past of a joint of robot ``env`` of every group."""
        data, history = self._data, self._data.history()
        if len(history.time) < 2:
            return
        past = history.time - history.time[-1]
        robots = env + data.per_group * np.arange(len(data.groups))
        arrays = (history.qpos, history.setpoint if self._sets_positions else history.qpos, history.effort)
        qpos, setpoint, effort = (array[:, robots, joint].T.astype(np.float64) for array in arrays)
        # A far limit would flatten the curve, and a gap (NaN) would empty the chart: such a limit repeats the curve.
        largest = np.abs(effort).max()
        limits = [
            np.full(len(past), limit) if abs(limit) < _LIMIT_RATIO * largest else effort[0]
            for limit in data.effort_limits(env, joint)
        ]
        described = data.robot.joints[joint]
        drawn = [*qpos, setpoint[0]] if self._sets_positions else qpos
        positions = np.round(drawn, 4)  # smaller differences make a flat line jitter
        for chart, title, curves in (
            (self._position, f"{described.name} [{described.unit}]", positions),
            (self._error, f"setpoint - qpos [{described.unit}]", setpoint - qpos),
            (self._effort, f"effort [{described.effort_unit}]", [*limits, *effort]),
        ):
            if chart.title != title:
                chart.title = title
            chart.data = (past, *curves)


_SIZE = 0.25
"""Length of an axis, in reaches of the robot."""


class TargetGizmo:
    """Draggable frame of a viser ``server`` at the setpoint of control "osc".

    Parameters
    ----------
    positions
        Positions of the robots on the page (envs, 3) [m].
    reach
        Reach of the robot [m].
    put
        Function that queues a request until the next frame.
    only_watched
        Function that returns whether a drag moves the target of the watched robot alone.
    """

    def __init__(
        self,
        server: Any,
        live: LiveSimulation,
        positions: NDArray[np.float64],
        reach: float,
        put: Callable[[Callable[[], object]], None],
        only_watched: Callable[[], bool],
    ) -> None:
        self._live, self._positions, self._put, self._only_watched = live, positions, put, only_watched
        self._env = 0
        self._shown: bytes | None = None
        self._frame = server.scene.add_transform_controls("/target", scale=_SIZE * reach, depth_test=False)
        self._frame.on_update(self._dragged)
        self.update(0)

    def update(self, env: int) -> None:
        """Put the frame at the target of a robot, unless it is there."""
        target = self._live.setpoint[env]
        if (env, target.tobytes()) != (self._env, self._shown):
            self._env, self._shown = env, target.tobytes()
            self._frame.position = tuple(self._positions[env] + target[:3])
            self._frame.wxyz = tuple(target[3:] / np.linalg.norm(target[3:]))

    async def _dragged(self, event: Any) -> None:
        if event.phase == "update":
            pose = np.concatenate([self._frame.position, self._frame.wxyz], dtype=np.float64)
            self._put(partial(self._move, self._env, pose))

    def _move(self, env: int, pose: NDArray[np.float64]) -> None:
        """Set the target to a pose on the page, between two frames; a refused one brings the frame back."""
        self._shown = None
        target = pose - np.concatenate([self._positions[env], np.zeros(4)])
        self._live.set_target(target, env=env if self._only_watched() else None)
        if env == self._env:  # the frame is where the pointer has it
            self._shown = self._live.setpoint[env].tobytes()
