"""Page that shows robots: their scene, charts of a joint, controls, and the loop that keeps real
time.
"""

from __future__ import annotations

import io
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, redirect_stdout
from functools import partial
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Document, Float64, Rows
from batchpid.errors import MissingDependencyError
from batchpid.sim.robot.findings import summary
from batchpid.sim.robot.shapes import Surface
from batchpid.sim.signals.rollout import Rollout
from batchpid.sim.view.panel import Panel, ViewData
from batchpid.sim.view.playback import HISTORY_SECONDS
from batchpid.sim.view.scene import FIELD_OF_VIEW, TILE, RobotScene

CHARTS_EVERY = 5
"""Frames between two updates of charts and status."""


class View(AbstractContextManager["View"]):
    """Page that shows ``data``, served at ``host`` and ``port``, or at a free port, until
    :meth:`close`.

    Only somebody who knows :attr:`url` can open it.

    Raises
    ------
    MissingDependencyError
        The package ``viser`` is missing.
    OSError
        The host is not an address of this machine.
    """

    def __init__(self, data: ViewData, *, host: str = "127.0.0.1", port: int = 8080) -> None:
        try:
            import viser

            from batchpid.sim.view.gate import Gate  # needs what viser needs
        except ImportError:
            raise MissingDependencyError("viser", "the browser view", "view") from None
        self.data = data
        gate = Gate(host, port)
        with redirect_stdout(io.StringIO()):  # viser's banner
            make = partial(
                viser.ViserServer, host=host, port=gate.port, verbose=False, label="batchpid"
            )
            self._server: Any = gate.start(make)
        self.port = gate.port
        """Port of the page."""
        name = "127.0.0.1" if host == "0.0.0.0" else host
        self.url = f"http://{name}:{gate.port}/{gate.token}/"
        """Address of the page, with the token that opens it."""
        self.rate, self.factor = 0.0, 0.0
        """Frames per second of wall time, and real-time factor."""
        gui = self._server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(43, 92, 199))
        # A browser without a GPU transforms every vertex in software: the more robots, the coarser.
        deviation = min(6e-3, 2.5e-4 + 1.25e-4 * data.num_envs)
        scene = RobotScene(data.robot, data.num_envs, data.ground, deviation)
        self.findings = summary(scene.findings)
        """Sentences on meshes that cannot be read."""
        self.panel = Panel(gui, data)
        self._nodes = SceneNodes(
            self._server, scene, data.frame().info.sets_positions, self.panel.select
        )
        gui.main_panel.dock_right()
        gui.main_panel.set_width(330)
        charts = gui.add_panel()
        with charts.add_tab("Charts"):
            self._charts = Charts(gui, data)
        charts.dock_left()
        charts.set_width(380)
        self._stopped = False

    def run(self, seconds: float | None = None) -> None:
        """Serve the page for ``seconds`` of wall time, or until :meth:`stop` or Ctrl-C."""
        data, panel = self.data, self.panel
        began = deadline = lap = time.monotonic()
        count = 0
        self._show(charts=True)
        while not self._stopped and (seconds is None or time.monotonic() - began < seconds):
            requested = panel.run_requests()
            running = panel.frames_left > 0
            if running:
                panel.frames_left -= 1
                data.advance()
                count += 1
            now = time.monotonic()
            due = running and count % CHARTS_EVERY == 0
            if due:
                self.rate = CHARTS_EVERY / (now - lap)
                self.factor = self.rate * data.period
                lap = now
            if running or requested:
                self._show(charts=requested or due)
            # A late frame is not caught up, which would only hurry the next ones.
            deadline = max(deadline + data.period / panel.speed, now)
            time.sleep(deadline - now)

    def _show(self, charts: bool) -> None:
        """Send the present frame to the pages, and with ``charts`` these and the status."""
        panel = self.panel
        frame = self.data.frame()
        self._nodes.update(frame, panel.env)
        if charts:
            self._charts.update(panel.env, panel.joint)
            panel.update_status(frame, self.factor, self.rate)

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


_SETPOINT_COLOUR = (70, 130, 255)
_NO_SHADOW = {"cast_shadow": False, "receive_shadow": False}


class SceneNodes:
    """A ``scene`` on a viser ``server``, with the setpoint of a robot if ``sets_positions`` of
    joints.

    ``select(robot)`` is called when a robot is clicked.

    Every surface is one node, which is placed once for each robot. A frame is therefore two small
    arrays for each surface, for any number of robots.
    """

    def __init__(
        self, server: Any, scene: RobotScene, sets_positions: bool, select: Callable[[int], None]
    ) -> None:
        import trimesh  # installed with viser

        self._server, self._scene = server, scene
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
        ring = trimesh.creation.annulus(
            0.30 * scene.reach, 0.335 * scene.reach, height=1e-3, sections=48
        )
        self._ring = api.add_mesh_simple(
            "/selected", ring.vertices, ring.faces, color=_SETPOINT_COLOUR, **_NO_SHADOW
        )
        count = len(scene.positions)
        self._robots: list[Any] = []
        self._setpoints: list[Any] = []
        for index, surface in enumerate(scene.surfaces):
            red, green, blue, alpha = surface.rgba
            colour = tuple(round(255 * value) for value in (red, green, blue))
            opacity = alpha if alpha < 1 else None
            node = self._add_surface(f"/robots/{index}", surface, count, colour, opacity=opacity)
            self._robots.append(node)
            if sets_positions:
                path = f"/setpoint/{index}"
                options = {"opacity": 0.22, **_NO_SHADOW}
                self._setpoints.append(
                    self._add_surface(path, surface, 1, _SETPOINT_COLOUR, **options)
                )
        for node in self._robots:
            node.on_click(lambda event: select(event.instance_index))
        camera = server.initial_camera
        camera.position, camera.look_at = tuple(scene.eye), tuple(scene.target)
        camera.fov = FIELD_OF_VIEW

    def update(self, frame: Rollout, env: int) -> None:
        """Place every robot, the ring under robot ``env``, and its setpoint."""
        scene = self._scene
        with self._server.atomic():
            if frame.base_pose is None:
                base = None
            else:
                base = frame.base_pose[0]
            _place(self._robots, scene.place(frame.qpos[0], base))
            self._ring.position = (*scene.positions[env][:2], scene.floor + 0.004)
            if self._setpoints:
                _place(self._setpoints, scene.poses(frame.setpoint[0, [env]], np.array([env])))

    def _add_surface(
        self, path: str, surface: Surface, copies: int, colour: Any, **options: Any
    ) -> Any:
        return self._server.scene.add_batched_meshes_simple(
            path,
            surface.vertices.astype(np.float32),
            surface.faces.astype(np.uint32),
            batched_wxyzs=np.tile(np.array([1, 0, 0, 0], np.float32), (copies, 1)),
            batched_positions=np.zeros((copies, 3), np.float32),
            batched_colors=colour,
            lod="off",
            **options,
        )


def _place(nodes: list[Any], poses: Float64) -> None:
    """Put the nodes of surfaces at poses (robots, surfaces, 7)."""
    for node, pose in zip(nodes, poses.astype(np.float32).swapaxes(0, 1), strict=True):
        node.batched_positions = np.ascontiguousarray(pose[:, :3])
        node.batched_wxyzs = np.ascontiguousarray(pose[:, 3:])


_MIN_RANGE = {"min": -0.012, "max": 0.012}
"""Smallest range of a vertical axis [rad, m, N m or N]: noise alone should not fill a chart."""
_SCALES = {
    "x": {
        "time": False,
        "range": (-HISTORY_SECONDS, 0.0),
    },  # without a fixed range the axis drifts in viser 1.1
    "y": {
        "range": {end: {"pad": 0.1, "soft": soft, "mode": 1} for end, soft in _MIN_RANGE.items()}
    },
}


class Charts:
    """Two charts in ``gui``: position and setpoint, and effort, of one joint of a robot."""

    def __init__(self, gui: Any, data: ViewData) -> None:
        self._data = data

        def chart(title: str, *series: Document) -> Any:
            return gui.add_uplot(
                (
                    np.array([-HISTORY_SECONDS, 0.0]),
                    *[np.zeros(2)] * len(series),
                ),  # flat until the first update
                ({"label": "s"}, *series),
                title=title,
                scales=_SCALES,
                legend={"show": True, "live": False},
                height=220,
                axes=({"size": 30, "stroke": "#6b7280"}, {"size": 56, "stroke": "#6b7280"}),
                padding=(4, 14, 0, 0),
            )

        setpoint = {"label": "setpoint", "stroke": "#4a82ff", "width": 1, "dash": [6, 4]}
        self._position = chart(
            "position", {"label": "qpos", "stroke": "#15803d", "width": 2}, setpoint
        )
        self._effort = chart("effort", {"label": "effort", "stroke": "#15803d", "width": 2})

    def update(self, env: int, joint: int) -> None:
        """Draw the recent past of a joint of robot ``env``."""
        history = self._data.history()
        past = history.time - history.time[-1]
        if len(past) < 2:
            return
        described = self._data.robot.joints[joint]
        positions = history.qpos[:, env, joint]
        if history.info.sets_positions:
            setpoints = history.setpoint[:, env, joint]
        else:
            setpoints = positions
        self._draw(
            self._position, f"{described.name} [{described.unit}]", past, positions, setpoints
        )
        self._draw(
            self._effort, f"effort [{described.effort_unit}]", past, history.effort[:, env, joint]
        )

    @staticmethod
    def _draw(chart: Any, title: str, past: Float64, *curves: Rows) -> None:
        if chart.title != title:
            chart.title = title
        # Smaller differences make a flat line jitter, and a number that is not finite would empty
        # the chart.
        chart.data = (
            past,
            *(np.nan_to_num(np.round(curve, 4).astype(np.float64)) for curve in curves),
        )
