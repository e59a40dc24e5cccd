"""Gate of the page: a request needs this server as its Host, no other page as its Origin, and the
token.

viser passes no options on to ``websockets.asyncio.server.serve``: :meth:`Gate.start` replaces it
while viser starts.
"""

from __future__ import annotations

import errno
import secrets
import socket
from collections.abc import Callable
from http import HTTPStatus
from typing import Any
from urllib.parse import urlsplit

import websockets.asyncio.server as websocket_server

from batchpid.errors import BatchPIDError


class Gate:
    """Socket at ``host`` and ``port``, or at a free port if that is in use, and the rule for
    requests to it.
    """

    def __init__(self, host: str, port: int) -> None:
        try:
            self.socket = socket.create_server((host, port))
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
            self.socket = socket.create_server((host, 0))
        self.port: int = self.socket.getsockname()[1]
        self.token = secrets.token_urlsafe(16)
        self._names = {host.lower(), "localhost", "127.0.0.1"}
        self._is_public = host == "0.0.0.0"
        if self._is_public:
            self._names.add(socket.gethostname().lower())

    def problem(self, hosts: list[str], origins: list[str], path: str) -> str | None:
        """Return why a request is refused, or None. A site can let its name point here: hence the
        check of Host.
        """
        try:
            name = urlsplit(f"//{hosts[0]}").hostname or ""
        except (ValueError, IndexError):
            name = ""
        is_address = self._is_public and name.replace(".", "").isdigit()
        if len(hosts) != 1 or not (name in self._names or is_address):
            return "this server has another name; open the address that was printed"
        if origins not in ([], [f"http://{hosts[0]}"]):
            return "pages of other sites have no access"
        if not secrets.compare_digest(
            path[1 : 1 + len(self.token)].encode(errors="replace"), self.token.encode()
        ):
            return "the token is missing; open the address that was printed"
        return None

    def start(self, make: Callable[[], Any]) -> Any:
        """Return the server of viser that ``make()`` starts, behind this gate."""
        serve = websocket_server.serve
        handlers = []

        def guarded(handler: Any, *_: Any, process_request: Any, **options: Any) -> Any:
            def process(connection: Any, request: Any) -> Any:
                headers = request.headers
                problem = self.problem(
                    headers.get_all("Host"), headers.get_all("Origin"), request.path
                )
                if problem is not None:
                    return connection.respond(HTTPStatus.FORBIDDEN, f"{problem}\n")
                request.path = request.path[1 + len(self.token) :] or "/"
                response = process_request(connection, request)
                if response is not None:
                    response.headers["Referrer-Policy"] = (
                        "no-referrer"  # the address holds the token
                    )
                return response

            handlers.append(handler)
            return serve(handler, sock=self.socket, process_request=process, **options)

        websocket_server.serve = guarded  # type: ignore[assignment, misc]
        try:
            server = make()
        finally:
            websocket_server.serve = serve  # type: ignore[misc]
        if not handlers:
            server.stop()
            raise BatchPIDError("this version of viser cannot be guarded; install version 1.1")
        return server
