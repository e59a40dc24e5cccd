"""Page that shows robots: their scene, controls, the chart of a joint, the loop that keeps real
time, and the gate that only the owner of its address passes.
"""

from __future__ import annotations

import io
import math
import re
import secrets
import socket
import time
from collections import deque
from collections.abc import Callable
from contextlib import AbstractContextManager, redirect_stdout
from functools import partial
from http import HTTPStatus
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any

import numpy as np

from batchpid.arrays.array_types import Rows
from batchpid.errors import BatchPIDError, MissingDependencyError
from batchpid.io.files import uninterrupted
from batchpid.sim.findings import summary
from batchpid.sim.view.scene import FIELD_OF_VIEW, TILE, RobotScene
from batchpid.sim.view.view_data import LiveSimulation, ViewData

if TYPE_CHECKING:
    from viser import ViserServer

HOST = "127.0.0.1"
"""Address of the server: only this machine reaches it."""
CHART_FRAMES = 5
"""Frames between two updates of chart and status."""
PAST_FRAMES = 240
"""Most frames that the chart shows."""
SERIES = (
    {"label": "s"},
    {"label": "qpos", "stroke": "#15803d", "width": 2},
    {"label": "setpoint", "stroke": "#4a82ff", "width": 1},
)
"""Time, and the curves of the chart."""


class View(AbstractContextManager["View"]):
    """Page that shows ``data``, served on this machine at ``port``, 0 for a free one, until
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
            viser.ViserServer,
            host=HOST,
            port=gate.port,
            verbose=False,
            label="batchpid",
        )
        with redirect_stdout(io.StringIO()):  # viser's banner
            self._server = gate.start(make)

        self.running = True
        """Whether frames follow each other, or the page is paused."""
        # viser calls back from another thread.
        self._requests: SimpleQueue[Callable[[], object]] = SimpleQueue()
        self._add_controls()
        # A browser without a GPU transforms every vertex in software.
        segments = 24 if data.num_envs < 9 else 12
        self._scene = RobotScene(data.robot, data.num_envs, data.ground, segments)
        self.findings = summary(self._scene.findings)
        """Sentences on meshes that cannot be read."""
        self._nodes = self._add_robots()

    def run(self, seconds: float | None = None) -> None:
        """Serve the page for ``seconds`` of wall time, or until :meth:`stop` or Ctrl-C."""
        data = self.data
        began = deadline = time.monotonic()
        count = 0
        self._show_robots()
        while not self._stopped and (seconds is None or time.monotonic() - began < seconds):
            requested = self._requests.qsize()
            for _ in range(requested):
                self._requests.get()()
            if self.running:
                data.advance()
            if requested or self.running:
                self._show_robots()
                self._past.append(np.stack([data.observation.qpos[0], data.setpoint[0]]))
            count += 1
            if count % CHART_FRAMES == 0:
                self._draw_chart()
            # A late frame is not caught up, which would only hurry the next ones.
            now = time.monotonic()
            deadline = max(deadline + data.period / self._speed.value, now)
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

    def _show_robots(self) -> None:
        """Send the poses of the present frame to the pages."""
        seen = self.data.observation
        poses = self._scene.place(seen.qpos, seen.base_pose).astype(np.float32).swapaxes(0, 1)
        with self._server.atomic():
            for node, pose in zip(self._nodes, poses, strict=True):
                node.batched_positions = np.ascontiguousarray(pose[:, :3])
                node.batched_wxyzs = np.ascontiguousarray(pose[:, 3:])

    def _draw_chart(self) -> None:
        """Draw the recent past of the chosen joint of the first robot, and update the status."""
        data = self.data
        diverged = int((~data.observation.ok).sum())
        self._status.content = f"t = {data.time:.2f} s, {diverged} diverged"
        joint = data.robot.joint_names.index(self._joint.value)
        # Smaller differences make a flat line jitter, and a number that is not finite would empty
        # the chart.
        rows = np.nan_to_num(np.round(np.array(self._past)[..., joint], 4))
        past = data.period * np.arange(1.0 - len(rows), 1.0)
        self._chart.data = (past, *rows.T)

    def _add_controls(self) -> None:
        """Add buttons for the motion, the chart, and a slider for the setpoint of each joint."""
        gui: Any = self._server.gui
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(330)
        self._status = gui.add_markdown("")
        motion = gui.add_button_group("Motion", ("Run", "Pause", "Reset"))
        motion.on_click(partial(self._request, self._control))
        self._speed = gui.add_slider("Speed", 0.1, 2.0, 0.1, 1.0)
        data = self.data
        self._past: deque[Rows] = deque(maxlen=PAST_FRAMES)
        self._joint = gui.add_dropdown("Joint", data.robot.joint_names)
        # Without a fixed range the axis drifts in viser 1.1.
        scales = {"x": {"time": False, "range": (-PAST_FRAMES * data.period, 0.0)}}
        self._chart = gui.add_uplot((np.zeros(2),) * 3, SERIES, scales=scales, height=200)
        if not isinstance(data, LiveSimulation):
            return
        # Followers move with their leaders.
        for index in np.flatnonzero(data.robot.independent).tolist():
            joint = data.robot.joints[index]
            # Fewer digits to read, inside the limits.
            low = math.ceil(1e3 * max(joint.lower, -2 * math.pi)) / 1e3
            high = math.floor(1e3 * min(joint.upper, 2 * math.pi)) / 1e3
            value = float(np.clip(data.setpoint[0, index], low, high))
            slider = gui.add_slider(f"{joint.name} [{joint.unit}]", low, high, 1e-3, value)
            slider.on_update(partial(self._request, partial(data.set_setpoint, joint=index)))

    # A coroutine, so that the changes stay in order.
    async def _request(self, action: Callable[[Any], object], event: Any) -> None:
        """Request ``action(value)`` with the value that a page gave a control."""
        self._requests.put(partial(action, event.target.value))

    def _control(self, button: str) -> None:
        """Carry out a button of the motion."""
        if button == "Reset":
            self.data.reset()
            self._past.clear()
        else:
            self.running = button == "Run"

    def _add_robots(self) -> list[Any]:
        """Add the scene to the page; return a node for each surface, which is placed once for each
        robot. A frame is therefore two small arrays for each surface, for any number of robots.
        """
        scene = self._scene
        api = self._server.scene
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
        nodes: list[Any] = []
        for index, surface in enumerate(scene.surfaces):
            colour = np.round(255 * np.asarray(surface.rgba)).astype(np.uint8)
            alpha = surface.rgba[3]
            node = api.add_batched_meshes_simple(
                f"/robots/{index}",
                surface.vertices.astype(np.float32),
                surface.faces.astype(np.uint32),
                batched_wxyzs=np.tile(np.array([1, 0, 0, 0], np.float32), (copies, 1)),
                batched_positions=np.zeros((copies, 3), np.float32),
                batched_colors=np.tile(colour[:3], (copies, 1)),
                opacity=alpha if alpha < 1 else None,
                lod="off",
            )
            nodes.append(node)
        camera = self._server.initial_camera
        camera.position = tuple(scene.eye)
        camera.look_at = tuple(scene.target)
        camera.fov = FIELD_OF_VIEW
        return nodes


class Gate:
    """Socket at ``port``, 0 for a free one, and the rule for requests to it: a request needs this
    server as its Host, no other page as its Origin, and the token.
    """

    def __init__(self, port: int) -> None:
        self.socket = socket.create_server((HOST, port))
        self.port: int = self.socket.getsockname()[1]
        self.token = secrets.token_urlsafe(16)

    def problem(self, hosts: list[str], origins: list[str], path: str) -> str | None:
        """Return why a request is refused, or None."""
        # A site can let its name point here: hence the check of Host. Its port may be a tunnel's.
        if len(hosts) != 1 or not re.fullmatch(r"(localhost|127\.0\.0\.1)(:\d+)?", hosts[0]):
            return "this server has another name; open the address that was printed"
        if origins not in ([], [f"http://{hosts[0]}"]):
            return "pages of other sites have no access"
        token = path[1 : 1 + len(self.token)].encode(errors="replace")
        if not secrets.compare_digest(token, self.token.encode()):
            return "the token is missing; open the address that was printed"
        return None

    def start(self, make: Callable[[], ViserServer]) -> ViserServer:
        """Return the server of viser that ``make()`` starts, behind this gate."""
        # viser passes no options on to it: it is replaced while viser starts.
        import websockets.asyncio.server as websocket_server

        serve = websocket_server.serve
        handlers = []

        def guarded(
            handler: Any,
            *_: Any,
            process_request: Any,
            **options: Any,
        ) -> Any:
            def process(connection: Any, request: Any) -> Any:
                hosts = request.headers.get_all("Host")
                origins = request.headers.get_all("Origin")
                problem = self.problem(hosts, origins, request.path)
                if problem is not None:
                    return connection.respond(HTTPStatus.FORBIDDEN, f"{problem}\n")
                request.path = request.path[1 + len(self.token) :] or "/"
                response = process_request(connection, request)
                if response is not None:
                    # The address holds the token.
                    response.headers["Referrer-Policy"] = "no-referrer"
                return response

            handlers.append(handler)
            return serve(
                handler,
                sock=self.socket,
                process_request=process,
                **options,
            )

        websocket_server.serve = guarded  # type: ignore[assignment, misc]
        try:
            server = make()
        finally:
            websocket_server.serve = serve  # type: ignore[misc]
        # A viser that starts its server in another way would be open to everybody.
        if not handlers:
            server.stop()
            raise BatchPIDError("this version of viser cannot be guarded; install version 1.1")
        return server
