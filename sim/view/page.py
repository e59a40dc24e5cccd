"""Page that shows robots: their scene, a chart of a joint, controls, and the loop that keeps real
time.
"""

from __future__ import annotations

import io
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, redirect_stdout
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from batchpid.errors import MissingDependencyError
from batchpid.io.files import uninterrupted
from batchpid.sim.findings import summary
from batchpid.sim.rollout import Rollout
from batchpid.sim.view.panel import Panel
from batchpid.sim.view.scene import FIELD_OF_VIEW, TILE, RobotScene
from batchpid.sim.view.view_data import HISTORY_SECONDS, ViewData

if TYPE_CHECKING:
    from viser import ViserServer

CHART_FRAMES = 5
"""Frames between two updates of chart and status."""
CURVE = {"label": "qpos", "stroke": "#15803d", "width": 2}
SETPOINT_CURVE = {"label": "setpoint", "stroke": "#4a82ff", "width": 1, "dash": [6, 4]}
SCALES = {
    # Without a fixed range the axis drifts in viser 1.1.
    "x": {"time": False, "range": (-HISTORY_SECONDS, 0.0)},
    # The smallest range [rad or m] keeps noise alone from filling a chart.
    "y": {
        "range": {
            "min": {"pad": 0.1, "soft": -0.012, "mode": 1},
            "max": {"pad": 0.1, "soft": 0.012, "mode": 1},
        }
    },
}


class View(AbstractContextManager["View"]):
    """Page that shows ``data``, served on this machine at ``port``, or at a free port, until
    :meth:`close`.

    Only somebody who knows :attr:`url` can open it.

    Raises
    ------
    MissingDependencyError
        The package ``viser`` is missing.
    """

    def __init__(self, data: ViewData, *, port: int = 8080) -> None:
        try:
            with uninterrupted():
                import viser

                # It needs what viser needs.
                from batchpid.sim.view.gate import HOST, Gate
        except ImportError:
            raise MissingDependencyError("viser", "the browser view", "view") from None
        self.data = data
        gate = Gate(port)
        self.port = gate.port
        """Port of the page."""
        self.url = f"http://{HOST}:{gate.port}/{gate.token}/"
        """Address of the page, with the token that opens it."""
        self._stopped = False
        make = partial(
            viser.ViserServer, host=HOST, port=gate.port, verbose=False, label="batchpid"
        )
        with redirect_stdout(io.StringIO()):  # viser's banner
            self._server = gate.start(make)

        # Controls on the right, a chart on the left, the scene between them.
        gui = self._server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(43, 92, 199))
        self.panel = Panel(gui, data)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(330)
        left = gui.add_panel()
        with left.add_tab("Chart"):
            self._chart = _add_chart(gui)
        left.dock_left()
        left.set_width(380)
        # A browser without a GPU transforms every vertex in software: the more robots, the coarser.
        deviation = min(6e-3, 2.5e-4 + 1.25e-4 * data.num_envs)
        scene = RobotScene(data.robot, data.num_envs, data.ground, deviation)
        self.findings = summary(scene.findings)
        """Sentences on meshes that cannot be read."""
        self._nodes = SceneNodes(self._server, scene, self.panel.select)

    def run(self, seconds: float | None = None) -> None:
        """Serve the page for ``seconds`` of wall time, or until :meth:`stop` or Ctrl-C."""
        data = self.data
        panel = self.panel
        began = deadline = lap = time.monotonic()
        count = 0
        rate = 0.0
        self._show(True, rate)
        while not self._stopped and (seconds is None or time.monotonic() - began < seconds):
            requested = panel.run_requests()
            running = panel.frames_left > 0
            if running:
                panel.frames_left -= 1
                data.advance()
                count += 1
            now = time.monotonic()
            due = running and count % CHART_FRAMES == 0
            if due:
                rate = CHART_FRAMES / (now - lap)
                lap = now
            if running or requested:
                self._show(requested or due, rate)
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
        with redirect_stdout(io.StringIO()):
            self._server.stop()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _show(self, chart: bool, rate: float) -> None:
        """Send the present frame to the pages, and with ``chart`` that and the status: ``rate`` is
        the number of frames per second of wall time.
        """
        frame = self.data.frame()
        self._nodes.update(frame)
        if chart:
            self._draw_chart()
            self.panel.update_status(frame, rate)

    def _draw_chart(self) -> None:
        """Draw the recent past of the watched joint: position and setpoint."""
        history = self.data.history()
        past = history.time - history.time[-1]
        # One row makes no curve.
        if len(past) < 2:
            return
        place = (slice(None), self.panel.env, self.panel.joint)
        joint = self.data.robot.joints[self.panel.joint]
        curves = [history.qpos[place]] * 2
        if history.info.sets_positions:
            curves[1] = history.setpoint[place]
        self._chart.title = f"{joint.name} [{joint.unit}]"
        # Smaller differences make a flat line jitter, and a number that is not finite would empty
        # the chart.
        rounded = [np.nan_to_num(np.round(curve, 4).astype(np.float64)) for curve in curves]
        self._chart.data = (past, *rounded)


class SceneNodes:
    """A ``scene`` on a viser ``server``; ``select(robot)`` is called when a robot is clicked.

    Every surface is one node, which is placed once for each robot. A frame is therefore two small
    arrays for each surface, for any number of robots.
    """

    def __init__(
        self, server: ViserServer, scene: RobotScene, select: Callable[[int], None]
    ) -> None:
        self._server = server
        self._scene = scene
        api = server.scene
        api.set_up_direction("+z")
        # Where a browser draws in software, the environment map costs more than all robots.
        api.configure_environment_map(None)
        api.configure_default_lights(enabled=True, cast_shadow=False)
        api.add_light_ambient("/lights/ambient", color=(235, 240, 255), intensity=1.3)
        api.add_grid(
            "/floor",
            *(2 * scene.half_floor),
            cell_size=TILE,
            section_size=2 * TILE,
            shadow_opacity=0.0,
            plane_color=(200, 208, 220),
            plane_opacity=float(scene.ground),
            position=(0.0, 0.0, scene.floor),
        )
        copies = len(scene.positions)
        self._robots: list[Any] = []
        for index, surface in enumerate(scene.surfaces):
            colour = np.round(255 * np.asarray(surface.rgba)).astype(np.uint8)
            alpha = surface.rgba[3]
            node: Any = api.add_batched_meshes_simple(
                f"/robots/{index}",
                surface.vertices.astype(np.float32),
                surface.faces.astype(np.uint32),
                batched_wxyzs=np.tile(np.array([1, 0, 0, 0], np.float32), (copies, 1)),
                batched_positions=np.zeros((copies, 3), np.float32),
                batched_colors=np.tile(colour[:3], (copies, 1)),
                opacity=alpha if alpha < 1 else None,
                lod="off",
            )
            node.on_click(lambda event: select(event.instance_index))
            self._robots.append(node)
        camera = server.initial_camera
        camera.position = tuple(scene.eye)
        camera.look_at = tuple(scene.target)
        camera.fov = FIELD_OF_VIEW

    def update(self, frame: Rollout) -> None:
        """Place every robot."""
        base = None
        if frame.base_pose is not None:
            base = frame.base_pose[0]
        poses = self._scene.place(frame.qpos[0], base).astype(np.float32).swapaxes(0, 1)
        with self._server.atomic():
            for node, pose in zip(self._robots, poses, strict=True):
                node.batched_positions = np.ascontiguousarray(pose[:, :3])
                node.batched_wxyzs = np.ascontiguousarray(pose[:, 3:])


def _add_chart(gui: Any) -> Any:
    """Return a new chart over the past, flat until the first update."""
    flat = (np.array([-HISTORY_SECONDS, 0.0]), np.zeros(2), np.zeros(2))
    return gui.add_uplot(
        flat,
        ({"label": "s"}, CURVE, SETPOINT_CURVE),
        scales=SCALES,
        legend={"show": True, "live": False},
        height=220,
        axes=({"size": 30, "stroke": "#6b7280"}, {"size": 56, "stroke": "#6b7280"}),
        padding=(4, 14, 0, 0),
    )
