"""A runner under kills, stops, Ctrl-C and warnings as errors is bit-identical to an undisturbed one in this process."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import tempfile
import threading
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)
from processes import send
from twin import ROBOT, CtrlC, N, Twin, nothing_left, undisturbed, warnings_raised

EXAMPLES = int(os.environ.get("BATCHPID_SOAK_MACHINES", "12"))
CTRL_C = CtrlC()
ENGINES = ["sapien", "mujoco"] if find_spec("mujoco") else ["sapien"]


class DisturbedRunner(RuleBasedStateMachine):
    """Calls of a runner with two workers, each of them disturbed or not."""

    disturbances = st.sampled_from(["none"] * 4 + ["kill", "kill, warnings as errors", "stop", "stop and go", "ctrl-c"])
    seeds = st.integers(0, 2**32 - 1)

    def __init__(self):
        super().__init__()
        self._stack = contextlib.ExitStack()
        self._stack.enter_context(nothing_left())
        self._folder = Path(self._stack.enter_context(tempfile.TemporaryDirectory()))

    @initialize(engine=st.sampled_from(ENGINES))
    def begin(self, engine):
        self.twin = Twin(self._folder, workers=2, engine=engine)

    def disturbance(self, kind, seed):
        """Return the disturbance of this kind."""
        pid = self.twin.runner.pids[seed % len(self.twin.runner.pids)]

        def disturb(act):
            run = warnings_raised if "errors" in kind else undisturbed
            if kind == "ctrl-c":
                return CTRL_C.after(random.Random(seed).uniform(0, 0.02))(act)
            if "kill" in kind:
                send(pid, signal.SIGKILL)
            if "stop" in kind:
                send(pid, signal.SIGSTOP)
            if "go" in kind:
                with later(0.05, lambda: send(pid, signal.SIGCONT)):
                    return run(act)
            return run(act)

        return disturb

    def setpoints(self, seed, ticks):
        noise = np.random.default_rng(seed).uniform(-0.3, 0.3, (ticks, N, ROBOT.dof))
        return np.clip(ROBOT.settings.target + noise, ROBOT.lower, ROBOT.upper)

    @rule(kind=disturbances, seed=seeds)
    def step(self, kind, seed):
        self.twin.step(self.setpoints(seed, 1)[0], self.disturbance(kind, seed))

    @rule(kind=disturbances, seed=seeds)
    def exchange(self, kind, seed):
        self.twin.exchange(self.setpoints(seed, 1)[0], self.disturbance(kind, seed))

    @rule(kind=disturbances, seed=seeds)
    def rollout(self, kind, seed):
        self.twin.rollout(self.setpoints(seed, 1 + seed % 20), self.disturbance(kind, seed))

    @rule(kind=disturbances, seed=seeds, mask=st.lists(st.booleans(), min_size=N, max_size=N))
    def reset(self, kind, seed, mask):
        pose = 0.9 * ROBOT.start + 0.1 * self.setpoints(seed, 1)[0]
        self.twin.reset(pose, np.array(mask), self.disturbance(kind, seed))

    @rule(kind=disturbances, seed=seeds, kp=st.floats(1.0, 50.0))
    def set_params(self, kind, seed, kp):
        self.twin.set_params(ROBOT.params(kp=kp), self.disturbance(kind, seed))

    @rule(kind=disturbances, seed=seeds)
    def snapshot(self, kind, seed):
        self.twin.snapshot(self.disturbance(kind, seed))

    @precondition(lambda self: self.twin.snapshots)
    @rule(kind=disturbances, seed=seeds)
    def restore(self, kind, seed):
        self.twin.restore(self.twin.snapshots[seed % len(self.twin.snapshots)], self.disturbance(kind, seed))

    @rule(kind=disturbances, seed=seeds)
    def record(self, kind, seed):
        self.twin.record(self.disturbance(kind, seed))

    @rule(kind=disturbances, seed=seeds)
    def reopen(self, kind, seed):
        self.twin.reopen(self.disturbance(kind, seed))

    @invariant()
    def agrees(self):
        self.twin.compare()

    def teardown(self):
        self.twin.close()
        del self.twin
        self._stack.close()


@contextlib.contextmanager
def later(seconds, act):
    """Call ``act`` in a thread after ``seconds``."""

    def act_if_alive():
        with contextlib.suppress(ProcessLookupError):
            act()

    timer = threading.Timer(seconds, act_if_alive)
    timer.start()
    try:
        yield
    finally:
        timer.join()


def run(examples, steps):
    run_state_machine_as_test(
        DisturbedRunner,
        settings=settings(
            max_examples=examples,
            stateful_step_count=steps,
            deadline=None,
            derandomize=True,
            database=None,
            suppress_health_check=list(HealthCheck),
        ),
    )


def test_calls_in_any_order_under_disturbances():
    run(1, 6)


@pytest.mark.slow
def test_very_many_calls_in_any_order_under_disturbances():
    run(EXAMPLES, 30)
