"""Exchange between a worker and its caller: messages over a stream socket, and arrays in shared memory.

The memory is an anonymous file (memfd), passed to the worker by file descriptor. The kernel frees it when the last
process that uses it ends, even by a crash, so nothing is left behind in /dev/shm.
"""

from __future__ import annotations

import io
import mmap
import os
import select
import socket
import struct
from collections.abc import Callable

import numpy as np

from batchpid.arrays.array_types import Rows
from batchpid.checks.single_owner import SingleOwner
from batchpid.errors import WorkerError
from batchpid.io.files import standard_streams_occupied
from batchpid.sim.loop.arrays import Layout

_HEAD = struct.Struct("<Q")  # bytes of the message that follows
_WAIT_INTERVAL = 0.1  # seconds between two calls of ``on_wait``
_MIN_READ, _MAX_READ = 1 << 12, 1 << 20  # bytes to read at once
_ALIGN = 64  # a cache line, so that two workers never write to the same one


class Channel:
    """One end of a connected stream socket.

    ``on_wait`` is called every 0.1 s during a wait for the other side to receive or send the rest of a message. An
    exception that it raises ends the wait.
    """

    def __init__(self, connection: socket.socket, on_wait: Callable[[], None] | None = None) -> None:
        self._socket, self._on_wait = connection, on_wait
        self._unread = b""  # received, but not yet returned
        connection.setblocking(on_wait is None)

    def fileno(self) -> int:
        """Return the file descriptor; it becomes readable when a message arrives or the other side closes."""
        return self._socket.fileno()

    def send(self, message: bytes) -> None:
        """Send a message. Raises OSError if the other side is closed."""
        rest = memoryview(_HEAD.pack(len(message)) + message)
        while rest:
            try:
                rest = rest[self._socket.send(rest, socket.MSG_NOSIGNAL) :]
            except BlockingIOError:
                self._wait(select.POLLOUT)

    def receive(self, begun: bytes = b"") -> bytes:
        """Wait for the next message and return it; ``begun`` are bytes of it that were already received.

        Raises
        ------
        EOFError, OSError
            The other side is closed.
        """
        self._unread += begun
        if not self._unread:
            try:
                self._unread = data = self._socket.recv(_MIN_READ)
            except BlockingIOError:
                self._unread = data = self._receive(_MIN_READ)
            if len(data) >= _HEAD.size and _HEAD.unpack_from(data)[0] == len(data) - _HEAD.size:  # nearly always
                self._unread = b""
                return data[_HEAD.size :]
        (count,) = _HEAD.unpack(self._read(_HEAD.size))
        return self._read(count)

    def close(self) -> None:
        """Close this end."""
        self._socket.close()
        self._on_wait = None  # it may refer to the channel's owner, whose files a cycle would keep open

    def _read(self, count: int) -> bytes:
        parts, missing = [self._unread], count - len(self._unread)
        while missing > 0:
            parts.append(self._receive(min(max(missing, _MIN_READ), _MAX_READ)))
            missing -= len(parts[-1])
        data = b"".join(parts)
        self._unread = data[count:]
        return data[:count]

    def _receive(self, most: int) -> bytes:
        """Wait for data and return between 1 and ``most`` bytes."""
        while True:
            try:
                part = self._socket.recv(most)
            except BlockingIOError:
                self._wait(select.POLLIN)
                continue
            if not part:
                raise EOFError("the other side is closed")
            return part

    def _wait(self, event: int) -> None:
        poll = select.poll()
        poll.register(self._socket, event)
        if not poll.poll(1e3 * _WAIT_INTERVAL) and (on_wait := self._on_wait) is not None:
            on_wait()


class SharedArrays(SingleOwner):
    """Named arrays in one block of shared memory: a new one, or the existing one with file descriptor ``fd``."""

    def __init__(self, layout: Layout, fd: int | None = None) -> None:
        self.layout = layout
        offsets, size = {}, 0
        for name, (shape, dtype) in layout.items():
            offsets[name] = size
            nbytes = int(np.prod(shape)) * np.dtype(dtype).itemsize
            size += -(-nbytes // _ALIGN) * _ALIGN
        if fd is None:
            self._file: MemoryFile | None = MemoryFile("batchpid")
            fd = self._file.fileno()
            try:
                os.ftruncate(fd, max(size, 1))
            except OSError as error:
                self._file.close()
                remedy = "raise the limit of file sizes (ulimit -f), or use fewer envs"
                raise WorkerError(f"{size} bytes of shared memory cannot be had: {error.strerror}; {remedy}") from error
        else:
            self._file = None
        self.fd = fd
        with standard_streams_occupied():
            memory = mmap.mmap(fd, max(size, 1))  # duplicates the descriptor
        self.arrays: dict[str, Rows] = {
            name: np.ndarray(shape, dtype, buffer=memory, offset=offsets[name])
            for name, (shape, dtype) in layout.items()
        }

    def close(self) -> None:
        """Close the descriptor. The memory is freed when no array refers to it."""
        if self._file is not None:
            self._file.close()
        self.arrays = {}


class MemoryFile(io.FileIO):
    """New anonymous file in memory, closed with its last reference."""

    def __init__(self, name: str) -> None:
        with standard_streams_occupied():
            super().__init__(os.memfd_create(name, os.MFD_CLOEXEC), "r+")

    def __del__(self) -> None:
        self.close()  # the base class would issue a ResourceWarning
