"""A runner that is disturbed, and its model, an undisturbed one in this process, which repeats its commands."""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import numpy as np
import psutil
from identical import assert_identical
from processes import children, have_ended, shared_memory
from robots import load_bundled

from batchpid.errors import CallOrderError
from batchpid.sim import Recorder, RecoveryWarning, Runner, Snapshot, read_recording

ROBOT = load_bundled("panda")
N = 2
SUBSTEPS = 5

Disturbance = Callable[[Callable[[], object]], None]
"""Calls a function and disturbs it; raises nothing that the disturbance made the function raise."""


def undisturbed(act: Callable[[], object]) -> None:
    """Call ``act``."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RecoveryWarning)
        act()


class CtrlC:
    """Disturbance: SIGINT after some seconds."""

    def __init__(self) -> None:
        self._delays: SimpleQueue[float] = SimpleQueue()
        self._armed = False
        self.happened = 0
        threading.Thread(target=self._send, daemon=True).start()

    def after(self, seconds: float) -> Disturbance:
        def disturb(act: Callable[[], object]) -> None:
            self._armed = True
            with contextlib.suppress(KeyboardInterrupt):
                self._delays.put(seconds)
                undisturbed(act)
                while self._armed:
                    time.sleep(1e-3)
                return
            self.happened += 1

        return disturb

    def _send(self) -> None:
        while True:
            time.sleep(self._delays.get())
            os.kill(os.getpid(), signal.SIGINT)
            self._armed = False


def warnings_raised(act: Callable[[], object]) -> None:
    """Call ``act`` with every warning as an error."""
    with warnings.catch_warnings(), contextlib.suppress(RecoveryWarning):
        warnings.simplefilter("error")
        act()


class Twin:
    """Runner that is disturbed, with its model.

    Every method does the same with both: first with the runner, disturbed, then with the model, if the runner has done
    it. It raises AssertionError where they differ.
    """

    def __init__(self, folder: Path, workers: int, engine: str = "sapien") -> None:
        self._folder, self._workers, self._files, self._others = folder, workers, 0, children()
        self._engine: Any = engine
        self.runner, self._model = self._make(workers), self._make(0)
        self._recorders: tuple[Recorder, Recorder] | None = None
        self.snapshots: list[Snapshot] = []

    def _make(self, workers: int) -> Runner:
        options: Any = {"substeps": SUBSTEPS, "checkpoint_steps": 40, "engine": self._engine}
        return Runner(ROBOT, N, params=ROBOT.params(), workers=workers, **options)

    def step(self, setpoint: Any, disturb: Disturbance = undisturbed) -> None:
        disturb(lambda: self.runner.step(setpoint))
        if self.runner.time != self._model.time:
            self._model.step(setpoint)
        self.compare()

    def exchange(self, setpoint: Any, disturb: Disturbance = undisturbed) -> None:
        """Send a tick and receive its observation."""

        def act() -> None:
            self.runner.send(setpoint)
            self.runner.recv()

        disturb(act)
        with contextlib.suppress(CallOrderError):  # it was sent, but its observation was not received
            self.runner.recv()
        if self.runner.time != self._model.time:
            self._model.step(setpoint)
        self.compare()

    def rollout(self, setpoints: Any, disturb: Disturbance = undisturbed) -> None:
        disturb(lambda: self.runner.rollout(setpoints))
        done = round((self.runner.time - self._model.time) / (SUBSTEPS * self.runner.timestep))
        if done:
            self._model.rollout(setpoints[:done])
        self.compare()

    def set_params(self, params: Any, disturb: Disturbance = undisturbed) -> None:
        before = self.runner.params
        disturb(lambda: setattr(self.runner, "params", params))
        assert self.runner.params is params or self.runner.params is before
        self._model.params = self.runner.params
        self.step(ROBOT.start)

    def reset(self, qpos: Any, mask: Any, disturb: Disturbance = undisturbed) -> None:
        before = self.runner.observe()
        disturb(lambda: self.runner.reset(qpos, mask=mask))
        after = self.runner.observe()
        self._model.reset(qpos, mask=mask)
        if not np.array_equal(after.qpos, before.qpos) or not np.array_equal(after.qvel, before.qvel):
            self.compare()
        self.runner.reset(qpos, mask=mask)  # the call may have been interrupted before it began
        self.step(ROBOT.start)

    def snapshot(self, disturb: Disturbance = undisturbed) -> None:
        taken: list[Snapshot] = []
        disturb(lambda: taken.append(self.runner.snapshot()))
        self.compare()
        if taken:
            assert_same_snapshot(taken[0], self._model.snapshot())
        else:  # the barrier is set or not
            taken.append(self.runner.snapshot())
            self._model.restore(taken[0])
        self.snapshots += taken
        self.step(ROBOT.start)

    def restore(self, snapshot: Snapshot, disturb: Disturbance = undisturbed) -> None:
        before = self.runner.time
        disturb(lambda: self.runner.restore(snapshot))
        assert self.runner.time in (before, snapshot.steps * self.runner.timestep)
        self.runner.restore(snapshot)
        self._model.restore(snapshot)
        self.compare()
        self.step(ROBOT.start)

    def record(self, disturb: Disturbance = undisturbed) -> None:
        """Begin a recording, or end the one that was begun."""
        if self._recorders is None:
            self._files += 1
            ours, theirs = (self._folder / f"{name}{self._files}.h5" for name in ("ours", "theirs"))
            disturb(lambda: Recorder(ours, self.runner))
            if self.runner.recorder is None:
                Recorder(ours, self.runner)
            Recorder(theirs, self._model)
            self._recorders = self.runner.recorder, self._model.recorder
        else:
            recorders, self._recorders = self._recorders, None
            disturb(recorders[0].close)
            for recorder in recorders:
                recorder.close()
            ours, theirs = (read_recording(recorder.path) for recorder in recorders)
            assert ours.info.complete
            assert len(ours.time) == len(theirs.time)
            assert_identical(ours, theirs)

    def reopen(self, disturb: Disturbance = undisturbed) -> None:
        """Close the runner, and go on with another one from a snapshot."""
        if self._recorders is not None:
            self.record()
        snapshots: list[Snapshot] = []
        undisturbed(lambda: snapshots.append(self.runner.snapshot()))  # a worker killed before is replaced now
        pids = self.runner.pids
        disturb(self.runner.close)
        self.runner.close()
        assert not self.runner.pids
        assert have_ended(pids)
        self._model.close()
        self.runner, self._model = self._make(self._workers), self._make(0)
        self.restore(snapshots[0])

    def construct(self, disturb: Disturbance = undisturbed) -> None:
        """Make one more runner and close it."""
        made: list[Runner] = []
        disturb(lambda: made.append(self._make(self._workers)))
        for runner in made:
            runner.close()
        made.clear()
        gc.collect()  # the exception and the frames that it holds refer to each other
        assert {child.pid for child in children() - self._others} == set(self.runner.pids)

    def compare(self) -> None:
        """Raise AssertionError unless the two agree."""
        assert_identical(self.runner.observe(), self._model.observe())
        assert self.runner.time == self._model.time
        for ours, theirs in zip(self.runner.params, self._model.params, strict=True):
            np.testing.assert_array_equal(ours, theirs)
        assert self.runner.faults == self._model.faults

    def close(self) -> None:
        """Close both; raise AssertionError if a process is left."""
        if self._recorders is not None:
            self.record()
        pids = self.runner.pids
        self.runner.close()
        self._model.close()
        assert have_ended(pids)


def assert_same_snapshot(ours: Snapshot, theirs: Snapshot) -> None:
    """Raise AssertionError unless the snapshots are bit-identical."""
    assert ours.steps == theirs.steps
    for name, rows in vars(theirs.states).items():
        for key, value in rows.items() if isinstance(rows, dict) else [("", rows)]:
            found = getattr(ours.states, name)
            assert (found[key] if key else found).tobytes() == value.tobytes(), (name, key)
    for mine, other in zip(ours.params, theirs.params, strict=True):
        np.testing.assert_array_equal(mine, other)


@contextlib.contextmanager
def nothing_left() -> Iterator[None]:
    """Raise AssertionError if the block leaves a process, or more than two file descriptors."""
    me = psutil.Process()
    others, descriptors, shared = children(), me.num_fds(), shared_memory()
    yield
    gc.collect()  # an mmap keeps its descriptor until the arrays on it are collected
    assert children() <= others
    assert me.num_fds() <= descriptors + 2
    assert shared_memory() <= shared
