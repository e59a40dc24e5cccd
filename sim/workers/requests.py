"""What a pool and its workers exchange: shared arrays, requests, the start of a loop; and the use of
a runner by one call at a time.

The memory of the arrays is an anonymous file (memfd), passed to the worker by file descriptor. The
kernel frees it when the last process that uses it ends, even by a crash, so nothing is left behind
in /dev/shm.
"""

from __future__ import annotations

# The module signal makes enums of handlers, which takes a twentieth of a tick.
import _signal
import mmap
import os
import threading
from dataclasses import dataclass, replace
from itertools import pairwise
from operator import itemgetter
from signal import SIGINT
from types import FrameType
from typing import Any, Self

import numpy as np

from batchpid.arrays.array_types import Rows
from batchpid.errors import InUseError, SingleOwner
from batchpid.io.files import standard_streams_occupied
from batchpid.sim.loop.arrays import Arrays, Layout
from batchpid.sim.loop.loop import Loop, part_of
from batchpid.sim.options.options import RunnerOptions
from batchpid.stages.values import Command

_ALIGN = 64  # a cache line, so that two workers never write to the same one


class SharedArrays(SingleOwner):
    """Arrays in one block of shared memory: a new one, or the existing one with file
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
        fields: dict[str, Rows] = {
            name: np.ndarray(shape, dtype, buffer=memory, offset=offsets[name])
            for name, (shape, dtype) in layout.items()
        }
        self.arrays = Arrays.from_fields(fields)

    def close(self) -> None:
        """Close the descriptor. The memory is freed when no array refers to it."""
        fd = self.fd
        self.fd = -1
        vars(self).pop("arrays", None)
        if fd >= 0:
            os.close(fd)


NO_COMMAND = Command(None)


@dataclass(frozen=True)
class Request:
    """Request to the loops of all envs of a pool: :meth:`batchpid.sim.loop.loop.Loop.execute`."""

    method: str
    """"run", or the name of a method of :class:`batchpid.sim.loop.env_group.EnvGroup`; "build" to
    make the loop from the :class:`Start` of each worker.
    """
    arguments: tuple[Any, ...] = ()
    """Arguments for all envs, which :func:`batchpid.sim.loop.loop.part_of` divides."""
    ticks: int = 0
    """Ticks of the arrays that hold observations afterwards; 0: the observation does not change."""
    substeps: int = 10
    """Sim steps of each tick, or the number of sim steps that take as long as the request."""
    command: Command = NO_COMMAND
    """Commands (ticks, envs, ...), which travel in the arrays."""
    changes_loop: bool = True
    """True if the replacement of a lost worker repeats the request, and an error in it closes the
    pool.
    """

    def for_envs(self, envs: slice) -> Self:
        """Return the request for some envs."""
        command = self.command.map(itemgetter((slice(None), envs)))
        return replace(self, arguments=part_of(self.arguments, envs), command=command)

    def write(self, arrays: Arrays, envs: slice) -> None:
        """Write the commands of some envs to the shared arrays (ticks, envs, ...)."""
        for table, rows in zip(arrays.command, self.command, strict=True):
            if rows is not None:
                table[: self.ticks, envs] = rows[:, envs]


BUILD = Request("build", changes_loop=False)
"""Start of every loop, with which a replay begins by itself."""


@dataclass(frozen=True)
class Start:
    """Inputs from which a worker builds its loop."""

    index: int
    """Number of the worker."""
    envs: slice
    """Rows in the arrays of the pool."""
    options: RunnerOptions
    first_env: int = 0
    """Number of the pool's first env within the runner; each node of a cluster has a pool for some
    of the envs.
    """

    @property
    def label(self) -> str:
        """Number and envs, for messages."""
        first = self.first_env + self.envs.start
        return f"{self.index} (envs {first} to {self.first_env + self.envs.stop - 1})"

    def build(self, arrays: Arrays) -> Loop:
        """Return the loop, with the shared arrays (ticks, envs, ...) of the pool's envs."""
        envs = slice(self.first_env + self.envs.start, self.first_env + self.envs.stop)
        return Loop(self.options, envs, arrays.at((slice(None), self.envs)))


def split(num_envs: int, parts: int) -> list[slice]:
    """Return contiguous slices of envs, as equal as they can be."""
    cuts = [num_envs * part // parts for part in range(parts + 1)]
    return [slice(low, high) for low, high in pairwise(cuts)]


_IN_USE = (
    "this Runner is in use: by another thread, by a call that this one interrupted, or by the process"
    " from which this one was forked; take turns, set flags in signal handlers, and make a Runner"
    " in each process"
)


class OneCall:
    """Use of a runner by one call at a time, from :meth:`begin` to :meth:`end`.

    In the main thread SIGINT is held back during the call: its handler, which may raise
    KeyboardInterrupt, is called in :meth:`end`. So a request to the workers is completed, and so is
    the change of the runner's state. A second SIGINT is not held back while :attr:`waits` is set;
    if its handler raises, the request is not completed, and the runner must be closed.
    """

    def __init__(self) -> None:
        self.waits = False
        """True while the call waits for workers, or runs the loop in this process."""
        self._owner, self._main = os.getpid(), threading.main_thread().ident
        self._user = 0  # identifier of the thread in a call
        self._handler: Any = None  # of SIGINT, while it is replaced
        self._is_held = False

    @property
    def in_use(self) -> bool:
        """True during a call, and in a forked child."""
        return self._user != 0 or os.getpid() != self._owner

    def check(self) -> None:
        """Raise InUseError if another call is in progress, or the runner belongs to another
        process.
        """
        if self.in_use:
            raise InUseError(_IN_USE)

    def begin(self) -> None:
        """Begin a call. Raises as :meth:`check`."""
        me = threading.get_ident()
        if self._user or os.getpid() != self._owner:
            raise InUseError(_IN_USE)
        # No function was called since the check. CPython switches threads and calls signal handlers
        # at calls of functions and at jumps back alone, so none can run in between.
        self._user = me
        self._handler = None
        self._is_held = False
        # The handler is None where it is not one of Python.
        if me == self._main and _signal.getsignal(SIGINT) is not None:
            try:
                self._handler = _signal.signal(SIGINT, self._on_interrupt)
            # An error of the handler, for a SIGINT that came before.
            except BaseException:
                self._user = 0
                raise

    def end(self) -> None:
        """End the call; then call the handler of a SIGINT that was held back."""
        self._user = 0
        self.waits = False
        handler = self._handler
        if handler is not None:
            _signal.signal(SIGINT, handler)
            if self._is_held:
                _signal.raise_signal(SIGINT)

    def _on_interrupt(self, number: int, frame: FrameType | None) -> None:
        is_second, self._is_held = self._is_held, True
        if is_second and self.waits:
            self._is_held = False
            if callable(self._handler):
                self._handler(number, frame)
            else:  # the system's, which ends the process
                _signal.signal(SIGINT, self._handler)
                _signal.raise_signal(SIGINT)
