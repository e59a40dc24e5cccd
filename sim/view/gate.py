"""Gate of the page: the address it listens on, the requests it answers, the messages it takes.

viser starts its server with ``websockets.asyncio.server.serve`` and passes no options on. :meth:`Gate.start`
temporarily replaces ``serve`` by a function that adds documented options of websockets. A server that starts without
them is an error.
"""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import secrets
import socket
import threading
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from http import HTTPStatus
from typing import Annotated, Any
from urllib.parse import urlsplit
from weakref import WeakSet

import msgspec
import websockets.asyncio.server as websocket_server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from batchpid.arrays.array_types import Document
from batchpid.errors import BatchPIDError, InvalidArgumentError
from batchpid.sim.view.address import listen

MAX_BYTES = 4096
"""Largest message of the page; the page's largest, a camera, has about 400 bytes."""
_Number = Annotated[float, msgspec.Meta(ge=-1e300, le=1e300)]
"""Finite number."""
_Text = Annotated[str, msgspec.Meta(max_length=200)]
_Vector = tuple[_Number, _Number, _Number]


class _Message(msgspec.Struct, tag_field="type", forbid_unknown_fields=True):
    """Message of viser's page. Its class of the same name in viser has these fields."""


class _Value(msgspec.Struct, forbid_unknown_fields=True):
    """Change of a control. viser would set any attribute of the control's state that a message names."""

    value: bool | _Number | _Text


class _GuiUpdateMessage(_Message, tag="GuiUpdateMessage"):
    """Control that was changed."""

    uuid: _Text
    updates: _Value


class _SceneNodeClickMessage(_Message, tag="SceneNodeClickMessage"):
    """Click on a robot."""

    name: _Text
    instance_index: int | None
    ray_origin: _Vector
    ray_direction: _Vector
    screen_pos: tuple[_Number, _Number]
    modifier: _Text | None
    owner: _Text = ""


class _ViewerCameraMessage(_Message, tag="ViewerCameraMessage"):
    """Camera of the page; viser counts a page as connected after its first."""

    wxyz: tuple[_Number, _Number, _Number, _Number]
    position: _Vector
    fov: _Number
    near: _Number
    far: _Number
    image_height: _Number
    image_width: _Number
    look_at: _Vector
    up_direction: _Vector


class _TransformControlsDragStartMessage(_Message, tag="TransformControlsDragStartMessage"):
    """Frame at the tool that the pointer takes."""

    name: _Text
    owner: _Text = ""


class _TransformControlsUpdateMessage(_Message, tag="TransformControlsUpdateMessage"):
    """Frame at the tool that was dragged."""

    name: _Text
    wxyz: tuple[_Number, _Number, _Number, _Number]
    position: _Vector
    owner: _Text = ""


class _TransformControlsDragEndMessage(_Message, tag="TransformControlsDragEndMessage"):
    """Frame at the tool that the pointer leaves."""

    name: _Text
    owner: _Text = ""


_DECODER = msgspec.msgpack.Decoder(
    _GuiUpdateMessage
    | _SceneNodeClickMessage
    | _ViewerCameraMessage
    | _TransformControlsDragStartMessage
    | _TransformControlsUpdateMessage
    | _TransformControlsDragEndMessage
)


def check_message(data: bytes | str) -> None:
    """Check that ``data`` is a message that the page may send.

    Raises
    ------
    InvalidArgumentError
        It is not.
    """
    try:
        if isinstance(data, str):
            raise ValueError("text instead of msgpack")
        _DECODER.decode(data)
    except (ValueError, RecursionError) as error:  # msgspec's errors are ValueErrors
        raise InvalidArgumentError("message", f"was not accepted: {error}", remedy="reload the page") from None


Refuse = Callable[[str], object]
"""Function that is called with the reason for a refusal."""
_STARTING = threading.Lock()
_LOG = logging.getLogger("batchpid.view")
_LOG.addHandler(logging.NullHandler())  # messages of strangers do not belong on the terminal


class Gate:
    """Gate at ``host`` and ``port``, or the next free port. A page needs the token in :attr:`url`.

    Requests whose Host is not a name of this server, or whose Origin is another page, get status 403, and so do those
    without the token. ``refuse`` is called with the reason for every message of a page that is not passed on.

    Raises
    ------
    InvalidArgumentError
        The host is not an address of this machine, or no port is free.
    """

    def __init__(self, host: str, port: int, refuse: Refuse) -> None:
        self._host, self._refuse = host.lower(), refuse
        self._socket = listen(host, port)
        self.port: int = self._socket.getsockname()[1]
        """Port that is listened on."""
        self._bound = ipaddress.ip_address(self._socket.getsockname()[0])
        self._token = secrets.token_urlsafe(16)
        shown = f"[{host}]" if ":" in host else host
        if self._bound.is_unspecified:
            shown = "127.0.0.1" if self._bound.version == 4 else "[::1]"
        self._loop: asyncio.AbstractEventLoop | None = None
        self._connections: WeakSet[_Connection] = WeakSet()
        self.url = f"http://{shown}:{self.port}/{self._token}/"
        """Address of the page, with the token."""

    def start(self, make: Callable[[], Any]) -> Any:
        """Return the server of viser that ``make()`` starts, behind this gate.

        Raises
        ------
        BatchPIDError
            This version of viser starts its server in another way.
        """
        serve, started = websocket_server.serve, []

        def guarded(handler: Any, host: Any = None, port: Any = None, **options: Any) -> Any:
            if not handler.__module__.startswith("viser."):
                return serve(handler, host, port, **options)
            started.append(handler)
            self._loop = asyncio.get_running_loop()
            self._loop.set_exception_handler(self._report)
            ours = {
                "sock": self._socket,
                "process_request": partial(self._process, options["process_request"]),
                "max_size": MAX_BYTES,
                "create_connection": self._connect,
                "logger": _LOG,
            }
            return serve(handler, **{**options, **ours})

        with _STARTING:
            websocket_server.serve = guarded  # type: ignore[assignment, misc]
            try:
                server = make()
            finally:
                websocket_server.serve = serve  # type: ignore[misc]
                if not started:
                    self._socket.close()
        if not started:
            server.stop()
            raise BatchPIDError("this version of viser cannot be guarded; install version 1.1")
        return server

    def close(self) -> None:
        """Abort the connections that have not sent their request yet.

        A browser opens such connections in advance, and would ask this server for the page of the next one.
        """
        if self._loop is not None:
            with suppress(RuntimeError):  # the loop has ended
                self._loop.call_soon_threadsafe(self._abort)

    def problem(self, hosts: list[str], origins: list[str], path: str) -> str | None:
        """Return why a request with these headers Host and Origin is refused, or None."""
        token, given = self._token.encode(), path.partition("?")[0].split("/")[1:2]
        if len(hosts) != 1 or not self._is_ours(hosts[0]):
            return "this server has another name; open the address that was printed"
        if origins and [origin.partition("://")[2].lower() for origin in origins] != [hosts[0].lower()]:
            return "pages of other sites have no access"
        if not given or not secrets.compare_digest(given[0].encode(errors="replace"), token):
            return "the token is missing; open the address that was printed"
        return None

    def _is_ours(self, host: str) -> bool:
        """Return whether a Host header names this server: an attacker can let any name point to any address."""
        try:
            name = (urlsplit(f"//{host}").hostname or "").rstrip(".")
        except ValueError:
            return False
        try:
            address = ipaddress.ip_address(name)
        except ValueError:
            # Of a machine that others reach, its name in any domain.
            named = name.partition(".")[0] == socket.gethostname().lower().partition(".")[0]
            return name in ("localhost", self._host) or (named and not self._bound.is_loopback)
        # A page cannot choose the address in its Host header, and the one in front of a container is not known here.
        return address.is_loopback or address == self._bound or self._bound.is_unspecified

    def _connect(self, *args: Any, **options: Any) -> ServerConnection:
        connection = _Connection(self._refuse, *args, **options)
        self._connections.add(connection)
        return connection

    def _abort(self) -> None:
        for connection in self._connections:
            if connection.request is None:
                connection.transport.abort()

    def _process(self, serve_page: Any, connection: ServerConnection, request: Request) -> Response | None:
        """Return the response to a request; None opens the web socket."""
        problem = self.problem(request.headers.get_all("Host"), request.headers.get_all("Origin"), request.path)
        if problem is not None:
            return connection.respond(HTTPStatus.FORBIDDEN, f"{problem}\n")
        rest = request.path[1 + len(self._token) :].lstrip("/")
        response: Response | None = serve_page(connection, Request(f"/{rest}", request.headers))
        if response is not None:
            response.headers["Referrer-Policy"] = "no-referrer"  # the address holds the token
        return response

    def _report(self, loop: asyncio.AbstractEventLoop, context: Document) -> None:
        """Report a value that viser cannot convert; viser raises in a task that nobody awaits."""
        error = context.get("exception")
        _LOG.error(context["message"], exc_info=error)
        if isinstance(error, ValueError | TypeError):
            self._refuse(str(error))


class _Connection(ServerConnection):
    """Web socket that passes on only what :func:`check_message` accepts."""

    def __init__(self, refuse: Refuse, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._refuse = refuse

    async def recv(self, decode: bool | None = None) -> Any:
        while True:
            data = await super().recv(decode)
            try:
                check_message(data)
            except InvalidArgumentError as error:
                self._refuse(str(error))
            else:
                return data
