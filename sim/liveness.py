"""Tell a stuck process from one that works, or waits for a core or for the disk."""

from __future__ import annotations

from pathlib import Path

_STATE, _CPU = 0, slice(11, 13)  # fields of /proc/PID/stat after the name: the state, user and system time
_IDLE = "ST"  # sleeping or stopped; R runs or is ready to, D waits for the disk, t is held by a debugger


class Pulse:
    """Looks at one process now and then, and says for how long it has been idle.

    Idle is asleep or stopped at every look, without any processor time between them. A process that is ready to run
    on a crowded machine is not idle, however long it waits.
    """

    def __init__(self, pid: int) -> None:
        self._path = Path(f"/proc/{pid}/stat")
        self._cpu: list[str] = []
        self._since = 0.0

    def begin(self, now: float) -> None:
        """Start to count at ``now`` [s], when there is something for the process to do."""
        self._since, self._cpu = now, []

    def idle(self, now: float) -> float:
        """Seconds up to ``now`` for which the process has been idle, as far as the looks so far can tell."""
        try:
            fields = self._path.read_text().rpartition(")")[2].split()
        except OSError:
            return 0.0  # it is gone, which its socket tells better
        if fields[_STATE] not in _IDLE or fields[_CPU] != self._cpu:
            self._since, self._cpu = now, fields[_CPU]
        return now - self._since

    @property
    def stopped(self) -> bool:
        """Whether the process is stopped, as by SIGSTOP."""
        try:
            return self._path.read_text().rpartition(")")[2].split()[_STATE] == "T"
        except OSError:
            return False
