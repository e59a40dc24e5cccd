"""Requests from which the replacement of a lost worker reaches the present state, bit by bit."""

from __future__ import annotations

import numpy as np

from batchpid.arrays.array_types import Bool
from batchpid.sim.workers.requests import Build, Request


class Replay:
    """Requests that changed the loops since a checkpoint; the first ones restore it.

    Parameters
    ----------
    most_ticks
        Ticks that are kept. With more since the last checkpoint a lost worker cannot be replaced.
    """

    def __init__(self, most_ticks: int) -> None:
        self._most_ticks = most_ticks
        self._waiting: Bool = np.zeros(0, bool)
        self.start_from(None)

    def start_from(self, request: Request | None) -> None:
        """Forget all requests; ``request`` brings a new worker to the present state, in which it is
        by itself with None.
        """
        self.requests: list[Request] = [Build()]
        """The requests, in their order; none if there were too many."""
        if request is not None:
            self.requests.append(request)
        self._ticks = 0
        self._next: list[Request] = []

    def start_at_resets(self, request: Request, num_envs: int) -> None:
        """Start from ``request``, which restores the present state, once every env was reset.

        Until then the earlier requests stay: an engine may have state that ``request`` does not
        restore, and that a reset clears.
        """
        self._next = [request]
        self._waiting = np.ones(num_envs, bool)

    @property
    def waits(self) -> bool:
        """True while envs have to be reset before the last checkpoint is of use."""
        return bool(self._next)

    def append(self, request: Request) -> None:
        """Add a request that all loops have executed."""
        self._ticks += max(1, request.ticks)
        if self.requests:
            self.requests.append(request)
        if self._next:
            self._next.append(request)
            if request.placed is not None:
                self._waiting = self._waiting & ~request.placed
            if not self._waiting.any():
                self.requests = [Build(), *self._next]
                self._ticks = sum(max(1, request.ticks) for request in self._next)
                self._next = []
        if self._ticks > self._most_ticks:
            self.requests = []
            self._next = []
