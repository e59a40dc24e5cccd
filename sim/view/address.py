"""Address that the page listens on."""

from __future__ import annotations

import errno
import socket
from typing import Any

from batchpid.errors import InvalidArgumentError

PORTS = 100
"""Number of ports that are tried, from the given one on."""


def resolve(host: str) -> Any:
    """Return the first address of ``host``, as ``socket.getaddrinfo`` gives it.

    Raises
    ------
    InvalidArgumentError
        The host cannot be resolved.
    """
    try:
        return socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
    except (OSError, ValueError) as error:  # a name that cannot be encoded raises a ValueError
        problem = f"cannot be resolved: {getattr(error, 'strerror', None) or error}"
    raise InvalidArgumentError("host", problem, value=host, remedy="use an address of this machine, or 127.0.0.1")


def listen(host: str, port: int) -> socket.socket:
    """Return a socket that listens on ``port``, or on the next free port.

    Raises
    ------
    InvalidArgumentError
        The host is not an address of this machine, or no port is free.
    """
    family, _, _, _, address = resolve(host)
    for candidate in range(port, min(port + PORTS, 2**16)):
        try:
            return socket.create_server((address[0], candidate, *address[2:]), family=family)
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                continue
            argument, value = ("port", candidate) if error.errno == errno.EACCES else ("host", host)
            problem = f"cannot be listened on: {error.strerror}"
            raise InvalidArgumentError(argument, problem, value=value, remedy="use another") from None
    raise InvalidArgumentError("port", f"and the next {PORTS} are in use", value=port, remedy="use another")
