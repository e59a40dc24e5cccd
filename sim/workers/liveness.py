"""Liveness of a process: stuck, or at work, or waiting for a core or for the disk."""

from __future__ import annotations

import os
from pathlib import Path

from batchpid.io.files import read_bytes

_STATE, _CPU = 0, slice(11, 13)  # fields of /proc/PID/stat after the name: the state, user and system time
_RUNNABLE, _IDLE, _STOPPED = "R", "ST", "T"  # S: asleep; others: D waits for the disk, t is held by a debugger
_CLOCK = os.sysconf("SC_CLK_TCK")


class Liveness:
    """Idle and busy time of one process while it has a request, from samples of its ``stat`` file in /proc.

    A process that waits for a core on a crowded machine is neither idle nor busy. A gap between two samples counts as
    ``max_gap`` seconds at most: the sampling process may have been stopped as well.
    """

    def __init__(self, stat: Path, max_gap: float = 0.2) -> None:
        self._stat, self._max_gap = str(stat), max_gap
        self.idle = 0.0
        """Seconds for which it has been asleep or stopped in every sample, without processor time between them."""
        self.busy = 0.0
        """Seconds since the first sample, without those in which it waited for a core."""
        self.stopped = False
        """Stopped, as by SIGSTOP."""
        self._last: tuple[float, float] | None = None

    def sample(self, now: float, is_first: bool = False) -> None:
        """Update the times at time ``now`` [s]; the first sample of a request resets them."""
        if is_first:
            self.idle, self.busy, self._last = 0.0, 0.0, None
        try:
            fields = read_bytes(self._stat).rpartition(b")")[2].decode().split()
        except OSError:
            return  # it has ended; its socket reports that
        state, cpu = fields[_STATE], sum(map(int, fields[_CPU])) / _CLOCK
        self.stopped = state == _STOPPED
        if self._last is not None:
            passed, ran = min(now - self._last[0], self._max_gap), cpu - self._last[1]
            self.idle = self.idle + passed if state in _IDLE and not ran else 0.0
            self.busy += ran if state == _RUNNABLE else max(ran, passed)
        self._last = now, cpu
