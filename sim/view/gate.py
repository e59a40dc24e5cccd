"""Gate of the page: a request needs this server as its Host, no other page as its Origin, and the
token.

viser passes no options on to ``websockets.asyncio.server.serve``: :meth:`Gate.start` replaces it
while viser starts.
"""

from __future__ import annotations

import errno
import re
import secrets
import socket
from collections.abc import Callable
from http import HTTPStatus
from typing import Any

import websockets.asyncio.server as websocket_server
from viser import ViserServer

from batchpid.errors import BatchPIDError

HOST = "127.0.0.1"
"""Address of the server: only this machine reaches it."""


class Gate:
    """Socket at ``port``, or at a free port if that is in use, and the rule for requests to it."""

    def __init__(self, port: int) -> None:
        try:
            self.socket = socket.create_server((HOST, port))
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
            self.socket = socket.create_server((HOST, 0))
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
            return serve(handler, sock=self.socket, process_request=process, **options)

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
