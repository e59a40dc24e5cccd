"""Trials: results and errors come from a child process, whose crash is reported and harms no other process."""

import os
import signal
import threading
import time

import pytest

from batchpid.errors import RobotError
from batchpid.sim.engine.sapien.trial import in_child


def refuse() -> None:
    raise RobotError("no such robot")


@pytest.mark.slow
def test_a_trial_runs_in_a_process_of_its_own():
    first, second = in_child(os.getpid), in_child(os.getpid)
    assert len({first, second, os.getpid()}) == 3
    assert in_child(divmod, 7, 3) == (2, 1)


def test_errors_are_raised_here():
    with pytest.raises(RobotError, match="no such robot"):
        in_child(refuse)


def test_a_crash_is_told_and_the_next_trial_runs():
    with pytest.raises(RobotError, match=f"crashes .exit status {-signal.SIGABRT}.*self_collision"):
        in_child(os.abort)
    assert in_child(abs, -1) == 1


def test_the_answer_to_an_interrupted_trial_is_not_that_to_the_next():
    in_child(abs, -1)
    threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT)).start()
    with pytest.raises(KeyboardInterrupt):
        in_child(time.sleep, 0.3)
    assert in_child(abs, -1) == 1
