"""Arrays in memory that processes share, without a name: nothing can be left behind in /dev/shm.

The memory is an anonymous file (memfd), handed to a child by file descriptor; the kernel frees it with its last user,
however that one ends.
"""

from __future__ import annotations

import mmap
import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.loop.arrays import Layout

_ALIGN = 64  # a cache line, so that two workers never write to the same one


class SharedArrays:
    """Named arrays of given ``layout`` in one block of shared memory: a new one, or with ``fd`` an existing one."""

    def __init__(self, layout: Layout, fd: int | None = None) -> None:
        self.layout = layout
        offsets, size = {}, 0
        for name, (shape, dtype) in layout.items():
            offsets[name] = size
            nbytes = int(np.prod(shape)) * np.dtype(dtype).itemsize
            size += -(-nbytes // _ALIGN) * _ALIGN
        if fd is None:
            fd = os.memfd_create("batchpid", os.MFD_CLOEXEC)
            os.ftruncate(fd, max(size, 1))
        self.fd = fd
        memory = mmap.mmap(fd, max(size, 1))
        self.arrays: dict[str, NDArray[Any]] = {
            name: np.ndarray(shape, dtype, buffer=memory, offset=offsets[name])
            for name, (shape, dtype) in layout.items()
        }

    def close(self) -> None:
        """Close the descriptor. The memory is freed when no array refers to it."""
        if self.fd >= 0:
            os.close(self.fd)
            self.fd = -1
        self.arrays = {}
