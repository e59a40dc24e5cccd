"""Baselines of the benchmark, which step an engine in worker processes without a Runner."""

from __future__ import annotations

import copy
import gc
import multiprocessing
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.sim.benchmark.tutorial import TutorialLoop, tutorial_settings
from batchpid.sim.benchmark.workload import Case, Workload
from batchpid.sim.engine.sapien.pack import Pack
from batchpid.sim.processes.background import BACKGROUND
from batchpid.sim.processes.fork_server import ONE_THREAD
from batchpid.sim.workers.placement import pinned_cores

TUTORIALS = ("tutorial", "tutorial, a process a core")
ENGINES = {
    # case: (whether each sim step visits all robots in turn, with collisions)
    "bare engine": (True, True),
    "bare engine, robot by robot": (False, True),
    "bare engine, no shapes": (False, False),
}


def make_baselines(workload: Workload) -> dict[str, Case]:
    """Return every baseline, by name. All use the same processes, each of which steps a share of the envs."""
    count = workload.processes
    bounds = [workload.num_envs * index // count for index in range(count + 1)]
    context, cores = multiprocessing.get_context("spawn"), pinned_cores(count)
    connections, processes = [], []
    for index in range(count):
        ours, theirs = context.Pipe()
        arguments = (theirs, workload, bounds[index + 1] - bounds[index])
        process = context.Process(target=_serve, args=arguments, daemon=True)
        with single_threaded():
            BACKGROUND.call(partial(_start, process))
        theirs.close()
        if cores:
            os.sched_setaffinity(process.pid or 0, {cores[index]})
        connections.append(ours)
        processes.append(process)

    def close() -> None:
        for connection in connections:
            connection.close()
        for process in processes:
            process.join(5.0)
            if process.is_alive():
                process.kill()

    def case(name: str) -> Case:
        used = connections[:1] if name == "tutorial" else connections
        envs = len(used) if name in TUTORIALS else workload.num_envs

        def reset() -> None:
            for connection in used:
                connection.send(name)
            for connection in used:
                connection.recv()

        def run() -> Float64:
            for connection in used:
                connection.send(None)
            finals = [connection.recv() for connection in used]
            return finals[0]

        return Case(workload.steps * envs, reset, run, close, len(used))

    return {name: case(name) for name in (*TUTORIALS, *(ENGINES if workload.engine == "sapien" else ["bare engine"]))}


def _start(process: BaseProcess) -> None:
    """Start a process that ignores Ctrl-C; called in the background thread, where SIGINT is blocked."""
    resource_tracker.ensure_running()  # otherwise the first start of a process does this, and unblocks SIGINT
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    process.start()


@contextmanager
def single_threaded() -> Iterator[None]:
    """Limit the BLAS of processes that start now to one thread, as the Runner does with its workers."""
    saved = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)
    try:
        yield
    finally:
        for name, value in saved.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


def _serve(connection: Connection, workload: Workload, share: int) -> None:
    """Receive the names of cases: reset each case, then run a round of it, until the connection is closed."""
    cases: dict[str, TutorialLoop | _DriveLoop | _MujocoLoop] = {}
    drive_loop = _DriveLoop if workload.engine == "sapien" else _MujocoLoop
    gc.disable()
    try:
        while True:
            name: str = connection.recv()
            if name not in cases:
                cases[name] = (
                    TutorialLoop(workload.robot, workload.target, start=workload.start)
                    if name in TUTORIALS
                    else drive_loop(name, workload, share)
                )
            cases[name].reset()
            connection.send(None)
            connection.recv()
            connection.send(cases[name].run(workload.steps))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        pass


class _DriveLoop:
    """Scenes under PhysX's drive, without control. They have no gravity, so that it reaches the target, as the PID."""

    def __init__(self, name: str, workload: Workload, share: int) -> None:
        self._in_turn, collisions = ENGINES[name]
        spec, settings = workload.scene(gravity=False, collisions=collisions), tutorial_settings(workload.robot)
        self._start, self._substeps = workload.start, workload.substeps
        self._packs = [Pack(spec, 1) for _ in range(share)]
        for pack in self._packs:
            pack.write_drive(np.array(settings.drive_stiffness), np.array(settings.drive_damping), np.array(np.inf))
            pack.write_drive_target(np.tile(workload.target, (pack.size, 1)))

    def reset(self) -> None:
        for pack in self._packs:
            rows = np.tile(self._start, (pack.size, 1))
            pack.write_state(range(pack.size), rows, np.zeros_like(rows))

    def run(self, steps: int) -> Float64:
        at_once = 1 if self._in_turn else self._substeps
        for _ in range(steps // at_once):
            for pack in self._packs:
                for _ in range(at_once):
                    pack.step()
        return self._packs[0].read_qpos()[0]


class _MujocoLoop:
    """The same robots in ``mujoco.batch``, under MuJoCo's position actuators; one call steps all of them."""

    def __init__(self, name: str, workload: Workload, share: int) -> None:
        import mujoco.batch

        from batchpid.sim.engine.mujoco.model_builder import robot_model

        settings = tutorial_settings(workload.robot)
        robot = robot_model(workload.scene(gravity=False), drives=True)
        self._start, self._columns, model = workload.start, robot.qpos, copy.copy(robot.model)
        model.actuator_biasprm[:, 1:3] = -settings.drive_stiffness, -settings.drive_damping
        self._batch = mujoco.batch.Batch(model, share, nthread=1, persistent=True)
        self._qpos, self._qvel = self._batch.bind("qpos"), self._batch.bind("qvel")
        self._batch.bind("ctrl")[...] = settings.drive_stiffness * workload.target

    def reset(self) -> None:
        self._qpos[:, self._columns], self._qvel[...] = self._start, 0.0

    def run(self, steps: int) -> Float64:
        for _ in range(steps):
            self._batch.step()
        return self._qpos[0, self._columns].copy()
