"""Arrays in memory that a worker shares with its caller.

The memory is an anonymous file (memfd), passed to the worker by file descriptor. The kernel frees
it when the last process that uses it ends, even by a crash, so nothing is left behind in /dev/shm.
"""

from __future__ import annotations

import mmap
import os

import numpy as np

from batchpid.arrays.array_types import Rows
from batchpid.errors import SingleOwner
from batchpid.io.files import standard_streams_occupied
from batchpid.sim.loop.arrays import Layout

_ALIGN = 64  # a cache line, so that two workers never write to the same one


class SharedArrays(SingleOwner):
    """Named arrays in one block of shared memory: a new one, or the existing one with file
    descriptor ``fd``.
    """

    def __init__(self, layout: Layout, fd: int | None = None) -> None:
        self.layout = layout
        offsets = {}
        size = 0
        for name, (shape, dtype) in layout.items():
            offsets[name] = size
            nbytes = int(np.prod(shape)) * np.dtype(dtype).itemsize
            size += -(-nbytes // _ALIGN) * _ALIGN
        with standard_streams_occupied():
            self.fd = os.memfd_create("batchpid") if fd is None else fd
            os.ftruncate(self.fd, max(size, 1))
            memory = mmap.mmap(self.fd, max(size, 1))  # duplicates the descriptor
        self.arrays: dict[str, Rows] = {
            name: np.ndarray(shape, dtype, buffer=memory, offset=offsets[name])
            for name, (shape, dtype) in layout.items()
        }

    def close(self) -> None:
        """Close the descriptor. The memory is freed when no array refers to it."""
        fd = self.fd
        self.fd = -1
        self.arrays = {}
        if fd >= 0:
            os.close(fd)
