"""Baselines of the benchmark, which step SAPIEN in worker processes without a Runner."""

from __future__ import annotations

import gc
import multiprocessing
import os
import signal
from contextlib import AbstractContextManager
from multiprocessing.connection import Connection
from typing import Any
from unittest import mock

import numpy as np
from tutorial import TutorialLoop
from workload import Case, Workload

from batchpid.sim.engine.sapien.pack import Pack
from batchpid.sim.workers.worker import ONE_THREAD, pinned_cores

TUTORIALS = ("tutorial", "tutorial, a process a core")
"""The tutorial's loop as written: one robot in one process, and one in each of the processes."""
ENGINES = {
    # PhysX's drive without control and gravity: (whether each sim step visits all robots in turn,
    # with collisions)
    "bare engine": (True, True),
    "bare engine, robot by robot": (False, True),  # each for a tick while it is in the cache
    "bare engine, no shapes": (False, False),
}


def make_baselines(workload: Workload) -> dict[str, Case]:
    """Return every baseline, by name. All use the same processes, each of which steps a share of
    the envs.
    """
    count = workload.processes
    bounds = [workload.num_envs * index // count for index in range(count + 1)]
    context, cores = multiprocessing.get_context("spawn"), pinned_cores(count)
    connections, processes = [], []
    for index in range(count):
        ours, theirs = context.Pipe()
        arguments = (theirs, workload, bounds[index + 1] - bounds[index])
        process = context.Process(target=_serve, args=arguments, daemon=True)
        with single_threaded():
            process.start()
        theirs.close()
        if cores:
            os.sched_setaffinity(process.pid, {cores[index]})
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

        def run() -> np.ndarray:
            for connection in used:
                connection.send(None)
            finals = [connection.recv() for connection in used]
            return finals[0]

        return Case(workload.steps * envs, reset, run, close, len(used))

    return {name: case(name) for name in (*TUTORIALS, *ENGINES)}


def single_threaded() -> AbstractContextManager[Any]:
    """Return a context in which new processes have a BLAS of one thread, as the Runner's workers
    have.
    """
    return mock.patch.dict(os.environ, ONE_THREAD)


def _serve(connection: Connection, workload: Workload, share: int) -> None:
    """Receive the names of cases: reset each case, then run a round of it, until the connection is
    closed.
    """
    cases: dict[str, TutorialLoop | DriveLoop] = {}
    signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # the caller ends at Ctrl-C, and closes the connection
    gc.disable()
    try:
        while True:
            name: str = connection.recv()
            if name not in cases:
                cases[name] = (
                    TutorialLoop(workload.robot, workload.target, start=workload.start)
                    if name in TUTORIALS
                    else DriveLoop(workload, share, workload.start, workload.target, *ENGINES[name])
                )
            cases[name].reset()
            connection.send(None)
            connection.recv()
            connection.send(cases[name].run(workload.steps))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        pass


class DriveLoop:
    """Robots of ``workload`` under PhysX's drive, from ``start`` to ``target`` (dof,) [rad or m],
    without control.

    They have no gravity, so that the drive reaches the target, as the PID does. ``in_turn``: each
    sim step visits all robots; otherwise each robot makes the sim steps of a tick before the next
    one does.
    """

    def __init__(
        self,
        workload: Workload,
        num_envs: int,
        start: np.ndarray,
        target: np.ndarray,
        in_turn: bool = False,
        collisions: bool = True,
    ) -> None:
        spec, settings = workload.weightless_scene(collisions), workload.robot.settings
        self._start, self._at_once = start, 1 if in_turn else workload.substeps
        self._packs = [Pack(spec, 1) for _ in range(num_envs)]
        for pack in self._packs:
            pack.write_drive(
                np.array(settings.drive_stiffness),
                np.array(settings.drive_damping),
                np.array(np.inf),
            )
            pack.write_drive_target(np.tile(target, (pack.size, 1)))
        self.reset()

    def reset(self) -> None:
        for pack in self._packs:
            rows = np.tile(self._start, (pack.size, 1))
            pack.write_state(range(pack.size), rows, np.zeros_like(rows))

    def run(self, steps: int) -> np.ndarray:
        for _ in range(steps // self._at_once):
            for pack in self._packs:
                for _ in range(self._at_once):
                    pack.step()
        return self._packs[0].read_qpos()[0]
