"""Messages between two processes over a socket; whoever waits for the other side can see to it meanwhile."""

from __future__ import annotations

import select
import socket
import struct
from collections.abc import Callable

_HEAD = struct.Struct("<Q")  # bytes of the message that follows
_LOOK = 0.1  # seconds between two calls of ``waiting``
_LEAST, _MOST = 1 << 12, 1 << 20  # bytes to read at once


class Channel:
    """One end of a stream ``connected`` to another one.

    ``waiting`` is called now and then while the other side does not take, or does not send, the rest of a message;
    what it raises ends the wait.
    """

    def __init__(self, connected: socket.socket, waiting: Callable[[], None] | None = None) -> None:
        self._socket, self._waiting = connected, waiting
        self._ahead = b""  # received, and not yet asked for
        connected.setblocking(waiting is None)

    def fileno(self) -> int:
        """File descriptor; it becomes readable when there is a message, or the other side is gone."""
        return self._socket.fileno()

    def send(self, message: bytes) -> None:
        """Send a message.

        Raises
        ------
        OSError
            The other side is gone.
        """
        rest = memoryview(_HEAD.pack(len(message)) + message)
        while rest:
            try:
                rest = rest[self._socket.send(rest) :]
            except BlockingIOError:
                self._wait(select.POLLOUT)

    def receive(self) -> bytes:
        """Wait for the next message.

        Raises
        ------
        EOFError, OSError
            The other side is gone.
        """
        (count,) = _HEAD.unpack(self._take(_HEAD.size))
        return self._take(count)

    def close(self) -> None:
        """Hang up."""
        self._socket.close()

    def _take(self, count: int) -> bytes:
        parts, lacking = [self._ahead], count - len(self._ahead)
        while lacking > 0:
            try:
                part = self._socket.recv(min(max(lacking, _LEAST), _MOST))
            except BlockingIOError:
                self._wait(select.POLLIN)
                continue
            if not part:
                raise EOFError("the other side is gone")
            parts.append(part)
            lacking -= len(part)
        taken = b"".join(parts)
        self._ahead = taken[count:]
        return taken[:count]

    def _wait(self, event: int) -> None:
        poll = select.poll()
        poll.register(self._socket, event)
        if not poll.poll(1e3 * _LOOK) and self._waiting is not None:
            self._waiting()
