"""Arrays in memory that processes share, without a name: nothing can be left behind in /dev/shm.

The memory is an anonymous file (memfd), handed to a child by file descriptor; the kernel frees it with its last user,
however that one ends.
"""

from __future__ import annotations

import io
import mmap
import os

import numpy as np

from batchpid.arrays.array_types import Rows
from batchpid.checks.single_owner import SingleOwner
from batchpid.errors import WorkerError
from batchpid.sim.loop.arrays import Layout
from batchpid.sim.processes.descriptors import standard_streams_occupied

_ALIGN = 64  # a cache line, so that two workers never write to the same one


class SharedArrays(SingleOwner):
    """Named arrays of given ``layout`` in one block of shared memory: a new one, or with ``fd`` an existing one."""

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
            memory = mmap.mmap(fd, max(size, 1))  # it holds a copy of the descriptor
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
        self.close()  # without the ResourceWarning of its base
