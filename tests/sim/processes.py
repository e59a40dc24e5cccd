"""Processes of tests: children, and waiting for an end."""

import contextlib
import os
import signal
import time

import psutil

PATIENCE = 200.0
"""Timeout [s] of events that should happen soon; long enough for a busy machine."""


def send(pid, number):
    """Send a signal to a process, if it still runs."""
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, number)


@contextlib.contextmanager
def handler(number, act):
    """Let ``act`` handle a signal; one of SIGALRM comes 0.2 s later."""
    before = signal.signal(number, act)
    signal.setitimer(signal.ITIMER_REAL, 0.2 if number == signal.SIGALRM else 0)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(number, before)


def have_ended(pids, seconds=PATIENCE):
    """Wait for processes to end, so long at most; return whether they have."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if not any(map(_runs, pids)):
            return True
        time.sleep(0.02)
    return False


def _runs(pid):
    try:
        return psutil.Process(pid).status() != "zombie"
    except psutil.NoSuchProcess:
        return False
