"""Page that shows robots: run a frame, show the previous one, keep real time."""

from __future__ import annotations

import io
import threading
import time
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, redirect_stdout, suppress
from functools import partial
from typing import Any

from batchpid.checks.single_owner import SingleOwner
from batchpid.errors import MissingDependencyError
from batchpid.sim.observation import Rollout
from batchpid.sim.robot.findings import summary
from batchpid.sim.view.charts import Charts
from batchpid.sim.view.data import ViewData
from batchpid.sim.view.gizmo import TargetGizmo
from batchpid.sim.view.panel import Panel
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
                panel.run_requests()
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
