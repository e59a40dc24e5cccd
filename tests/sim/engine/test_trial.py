"""Trials: results and errors come from a child process, whose crash is reported and harms no other process."""

import os
import signal
import subprocess
import sys
import threading
import time

import psutil
import pytest
from processes import children, have_ended

from batchpid.errors import RobotError
from batchpid.sim.engine.sapien.trial import in_child


def parent_and_self() -> tuple[int, int]:
    return os.getppid(), os.getpid()


def refuse() -> None:
    raise RobotError("no such robot")


def test_a_trial_runs_in_a_child_of_one_server():
    (server, first), (again, second) = in_child(parent_and_self), in_child(parent_and_self)
    assert server == again
    assert len({server, first, second, os.getpid()}) == 4
    assert in_child(divmod, 7, 3) == (2, 1)


def test_errors_are_raised_here():
    with pytest.raises(RobotError, match="no such robot"):
        in_child(refuse)


def test_a_crash_is_told_and_the_next_trial_runs():
    with pytest.raises(RobotError, match=f"crashes .exit status {-signal.SIGABRT}.*self_collision"):
        in_child(os.abort)
    assert in_child(abs, -1) == 1


def test_a_server_that_has_ended_is_replaced():
    server, _ = in_child(parent_and_self)
    os.kill(server, signal.SIGKILL)
    assert in_child(parent_and_self)[0] != server


def test_the_answer_to_an_interrupted_trial_is_not_that_to_the_next():
    in_child(abs, -1)
    threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT)).start()
    with pytest.raises(KeyboardInterrupt):
        in_child(time.sleep, 0.3)
    assert in_child(abs, -1) == 1


def test_a_server_is_no_child_of_its_caller_and_ends_with_it():
    server, _ = in_child(parent_and_self)
    assert psutil.Process(server) not in children()
    program = "import os; from batchpid.sim.engine.sapien.trial import in_child; print(in_child(os.getppid))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert have_ended([int(done.stdout)])
