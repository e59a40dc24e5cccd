"""The loop of a view: run a frame, show the last, keep real time."""

from __future__ import annotations

import io
import threading
import time
from collections import deque
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, redirect_stdout
from typing import Any

from batchpid.errors import MissingDependencyError
from sim.view.charts import Charts
from sim.view.data import Frame, Source
from sim.view.panel import Panel
from sim.view.scene import RobotScene

CHARTS_EVERY = 5
"""Frames from one drawing of the charts to the next."""
STATUS_EVERY = 15


class View:
    """A page that shows ``source``, served from ``host`` and ``port`` until :meth:`close`.

    ``url`` is its address. ``rate`` and ``factor`` say what the loop achieves: frames a second, and simulated seconds a
    second.

    Raises
    ------
    MissingDependencyError
        Without the ``viser`` package.
    """

    def __init__(self, source: Source, *, host: str = "127.0.0.1", port: int = 8080) -> None:
        try:
            import viser
        except ImportError:
            raise MissingDependencyError("viser", "the browser view", "view") from None
        self.source = source
        with _quiet():
            self._server: Any = viser.ViserServer(host=host, port=port, verbose=False, label="batchpid")
        self.url = f"http://{'127.0.0.1' if host in ('0.0.0.0', '') else host}:{self._server.get_port()}"
        gui = self._server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(43, 92, 199))
        self._scene = RobotScene(self._server, source.robot, source.groups, source.per_group)
        self.panel = Panel(self._server, source)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(330)
        charts = gui.add_panel()
        with charts.add_tab("Charts"):
            self._charts = Charts(gui, source)
        charts.dock_left()
        charts.set_width(380)
        self._scene.on_click(self.panel.select)
        self.rate, self.factor = 0.0, 0.0
        self._stop = False
        self._shown: tuple[Any, ...] = ()
        self._settled = False

    def run(self, seconds: float | None = None) -> None:
        """Serve the page; for ``seconds`` of wall time, or until :meth:`stop` or Ctrl-C."""
        source, panel = self.source, self.panel
        began = deadline = time.monotonic()
        laps: deque[tuple[float, float]] = deque([(began, source.frame().time)], maxlen=45)
        count = 0
        with ThreadPoolExecutor(1) as simulate:
            while not self._stop and (seconds is None or time.monotonic() - began < seconds):
                panel.work()
                moving = panel.playing or panel.steps > 0
                panel.steps = max(0, panel.steps - 1)
                frame = source.frame()
                # The workers compute the next frame while this one goes out.
                job = simulate.submit(source.advance) if moving else None
                if self._server.get_clients():
                    self._show(frame, count)
                if job is not None:
                    job.result()
                now = time.monotonic()
                laps.append((now, source.frame().time))
                self._measure(laps)
                count += 1
                # A frame that came late is not made up for: that would only make the next ones hurry.
                deadline = max(deadline + source.period / panel.speed, now)
                time.sleep(max(0.0, deadline - now))

    def stop(self) -> None:
        """Let :meth:`run` return after the present frame. May be called from any thread."""
        self._stop = True

    def close(self) -> None:
        """End the page, and what the source holds."""
        self._stop = True
        self.source.close()
        # Once a browser was there, viser takes some 5 s to end its threads. They are daemons: nobody need wait.
        end = threading.Thread(target=self._server.stop, daemon=True)
        with _quiet():
            end.start()
            end.join(timeout=0.5)

    def __enter__(self) -> View:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # -- inside ----------------------------------------------------------------------------------------------------

    def _show(self, frame: Frame, count: int) -> None:
        """Send what has changed; charts and status only now and then while the robots move."""
        panel = self.panel
        wanted = (
            frame.qpos.tobytes(),
            frame.setpoint.tobytes(),
            frame.time,
            panel.env,
            panel.joint,
            panel.ghost,
        )
        still = wanted == self._shown
        if not still:
            self._scene.show(frame, panel.env, panel.ghost)
        if (not still and count % CHARTS_EVERY == 0) or (still and not self._settled):
            self._charts.show(panel.env, panel.joint)
        if (not still and count % STATUS_EVERY == 0) or (still and not self._settled):
            panel.tell(frame, self.factor, self.rate)
        self._shown, self._settled = wanted, still

    def _measure(self, laps: deque[tuple[float, float]]) -> None:
        (first, start), (last, end) = laps[0], laps[-1]
        if last > first:
            self.rate, self.factor = (len(laps) - 1) / (last - first), max(0.0, end - start) / (last - first)


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep viser's own banner off the terminal: the caller says where the page is."""
    with redirect_stdout(io.StringIO()):
        yield
