"""Children of the fork server: settings of the caller, exit status, and ends."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
from multiprocessing.connection import Connection, Pipe
from pathlib import Path

import psutil
import pytest
from processes import PATIENCE, have_ended

from batchpid.sim.processes import fork_server
from batchpid.sim.processes.background import BACKGROUND
from batchpid.sim.processes.fork_server import Child, fork, server_pid


def start(main: str, environment: dict[str, str] | None = None) -> tuple[Child, Connection]:
    ours, theirs = Pipe()
    with theirs:
        child = BACKGROUND.call(
            lambda: fork(f"{__name__}:{main}", [theirs.fileno()], environment=environment, imports=["no_such_module"])
        )
    return child, ours


def tell(descriptor: int) -> None:
    """Send the settings of this process."""
    with Connection(descriptor) as connection:
        limits = resource.getrlimit(resource.RLIMIT_CORE)
        files = {int(each) for each in os.listdir("/proc/self/fd")}
        seen = os.getcwd(), os.sched_getaffinity(0), limits, os.environ.get("COLOUR"), sys.path, os.getppid(), files
        connection.send((*seen, descriptor))


def fail(descriptor: int) -> None:
    raise RuntimeError(f"no use for {descriptor}")


def wait(descriptor: int) -> None:
    signal.pause()


def test_a_child_has_the_settings_of_its_caller_and_nothing_else(tmp_path: Path, monkeypatch):
    cores, limits = os.sched_getaffinity(0), resource.getrlimit(resource.RLIMIT_CORE)
    start("wait")[0].kill()  # the server is there before the settings change
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    server = server_pid()
    try:
        os.sched_setaffinity(0, {min(cores)})
        resource.setrlimit(resource.RLIMIT_CORE, (0, limits[1]))
        child, connection = start("tell", {"COLOUR": "green"})
    finally:
        os.sched_setaffinity(0, cores)
        resource.setrlimit(resource.RLIMIT_CORE, limits)
    with connection:
        folder, affinity, core, colour, path, parent, files, descriptor = connection.recv()
    assert child.wait() == 0
    assert (folder, affinity, core, colour) == (str(tmp_path), {min(cores)}, (0, limits[1]), "green")
    assert path[: len(sys.path)] == sys.path
    assert parent == server == server_pid() != os.getpid()
    assert len(files - {0, 1, 2, descriptor}) == 1  # the folder that was listed


@pytest.mark.slow
def test_another_environment_starts_another_server(monkeypatch):
    first, _ = start("wait")
    before = server_pid()
    monkeypatch.setenv("COLOUR", "red")
    second, connection = start("tell")
    with connection:
        assert connection.recv()[3] == "red"
    assert server_pid() != before
    assert first.poll() is None  # its server stays until it ends
    first.kill()
    assert first.wait() == -signal.SIGKILL
    assert second.wait() == 0
    assert have_ended([before])
    monkeypatch.setenv("COLOUR", "green")
    blocked = BACKGROUND.call(lambda: signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGCHLD]))
    try:
        third, _ = start("wait")
    finally:
        BACKGROUND.call(lambda: signal.pthread_sigmask(signal.SIG_SETMASK, blocked))
    third.kill()
    assert third.wait(PATIENCE) == -signal.SIGKILL  # also where the caller blocks the signal of an ended child
    assert not psutil.pid_exists(before)  # its end was collected


def test_an_error_is_printed_and_is_the_exit_status(capfd):
    child, _ = start("fail")
    assert child.wait(60.0) == child.poll() == 1
    assert "RuntimeError: no use for" in capfd.readouterr().err


def test_wait_has_a_limit():
    child, _ = start("wait")
    with pytest.raises(subprocess.TimeoutExpired):
        child.wait(0.01)
    child.send_signal(signal.SIGTERM)
    assert child.wait() == -signal.SIGTERM
    child.send_signal(signal.SIGTERM)  # of no effect


@pytest.mark.slow
def test_children_end_with_a_server_that_is_killed_and_another_takes_its_place():
    child, _ = start("wait")
    os.kill(server_pid(), signal.SIGKILL)
    assert child.wait() == -signal.SIGKILL
    assert have_ended([child.pid])
    other, connection = start("tell")
    with connection:
        connection.recv()
    assert other.wait() == 0


def test_a_server_that_cannot_start_is_an_error(monkeypatch):
    monkeypatch.setattr(fork_server, "_PROGRAM", "raise SystemExit(3)")
    monkeypatch.setenv("COLOUR", "blue")
    with pytest.raises(OSError, match="ended at its own start"):
        start("wait")


@pytest.mark.slow
def test_a_server_without_children_ends(monkeypatch):
    monkeypatch.setattr(fork_server, "_PROGRAM", fork_server._PROGRAM.replace("serve()", "serve(0.2)"))
    monkeypatch.setenv("COLOUR", "black")
    child, _ = start("wait")
    server = psutil.Process(server_pid())
    child.kill()
    assert have_ended([server.pid])
    again, _ = start("wait")
    again.kill()
    assert server_pid() != server.pid
