"""Tell a stuck process from one that works, or waits for a core or for the disk."""

from __future__ import annotations

import os
from pathlib import Path

_STATE, _CPU = 0, slice(11, 13)  # fields of /proc/PID/stat after the name: the state, user and system time
_RUNS, _IDLE, _STOPPED = "R", "ST", "T"  # S sleeps; D waits for the disk, t is held by a debugger
_CLOCK = os.sysconf("SC_CLK_TCK")


class Pulse:
    """Looks at one process now and then while it has something to do.

    A process that is ready to run on a crowded machine neither is idle nor uses up its time, however long it waits.
    Nor does time count in which nobody looked: whoever looks may have been stopped, too.
    """

    def __init__(self, pid: int, gap: float = 0.2) -> None:
        """Look at process ``pid``, every ``gap`` seconds at least."""
        self._path, self._gap = Path(f"/proc/{pid}/stat"), gap
        self.begin()

    def begin(self) -> None:
        """Start to count: there is something for the process to do."""
        self.idle = 0.0
        """Seconds for which it has been asleep or stopped at every look, without any processor time between them."""
        self.spent = 0.0
        """Seconds since the first look, without those in which it waited for a processor."""
        self.stopped = False
        """Whether it is stopped, as by SIGSTOP."""
        self._last: tuple[float, float] | None = None

    def look(self, now: float) -> None:
        """Bring all that up to date at time ``now`` [s]."""
        try:
            fields = self._path.read_text().rpartition(")")[2].split()
        except OSError:
            return  # it is gone, which its socket tells better
        state, cpu = fields[_STATE], sum(map(int, fields[_CPU])) / _CLOCK
        self.stopped = state == _STOPPED
        if self._last is not None:
            passed, ran = min(now - self._last[0], self._gap), cpu - self._last[1]
            self.idle = self.idle + passed if state in _IDLE and not ran else 0.0
            self.spent += ran if state == _RUNS else max(ran, passed)
        self._last = now, cpu
