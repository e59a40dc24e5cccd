"""Processes that step scenes without a Runner: baselines of :mod:`sim.benchmark.benchmark`."""

from __future__ import annotations

import gc
import multiprocessing
import os
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.connection import Connection

import numpy as np
from numpy.typing import NDArray

from sim.benchmark.setup import Setup
from sim.benchmark.tutorial import TutorialLoop
from sim.engine.building import parse
from sim.engine.pack import Pack
from sim.workers.pool import cores_of_their_own
from sim.workers.worker import ONE_THREAD

Float64 = NDArray[np.float64]
ENGINES = {
    # case: (scenes to a PhysX system, whether all systems are stepped in turn)
    "drive, a scene a robot": (1, True),
    "bare engine, packs of 8": (8, True),
    "bare engine": (4, True),  # as in the Runner: the fastest of 1, 2, 4, 8 and 16
    "bare engine, pack by pack": (4, False),
}


def run_baseline(case: str, processes: Sequence[BaselineProcess], setup: Setup) -> tuple[float, int, Float64]:
    """Run one round of ``case`` on ``processes`` at once: (seconds, env-steps, where the first env ended)."""
    for process in processes:
        process.prepare(case)
    began = time.perf_counter()
    for process in processes:
        process.go()
    results = [process.result() for process in processes]
    seconds = time.perf_counter() - began
    return seconds, sum(steps for steps, _ in results), results[0][1]


class BaselineProcess:
    """A process that steps its share of the scenes by process, case after case."""

    def __init__(self, setup: Setup, index: int) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        count = max(setup.workers, 1)
        share = setup.num_envs * (index + 1) // count - setup.num_envs * index // count
        with single_threaded():
            self._process = context.Process(target=_serve, args=(theirs, setup, share), daemon=True)
            self._process.start()
        theirs.close()
        if cores := cores_of_their_own(count):
            os.sched_setaffinity(self._process.pid or 0, {cores[index]})

    def prepare(self, case: str) -> None:
        """Build what ``case`` needs, and put its robots at the start."""
        self._connection.send(case)
        self._connection.recv()

    def go(self) -> None:
        """Begin to step."""
        self._connection.send(None)

    def result(self) -> tuple[int, Float64]:
        """Wait for the env-steps made, and where the first env ended."""
        steps, final = self._connection.recv()
        return steps, final

    def close(self) -> None:
        """End the process."""
        self._connection.close()
        self._process.join(5.0)
        if self._process.is_alive():
            self._process.kill()


@contextmanager
def single_threaded() -> Iterator[None]:
    """Let processes that start now keep to one thread in their BLAS, as the Runner's workers do."""
    saved = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in saved.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


def _serve(connection: Connection, setup: Setup, share: int) -> None:
    cases: dict[str, _Tutorial | _Engine] = {}
    gc.disable()
    try:
        while True:
            case: str = connection.recv()
            if case not in cases:
                cases[case] = _Tutorial(setup) if case.startswith("tutorial") else _Engine(case, setup, share)
            cases[case].reset()
            connection.send(None)
            connection.recv()
            connection.send(cases[case].run(setup.ticks * setup.substeps))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        pass


class _Tutorial:
    """The tutorial's loop, alone in its process."""

    def __init__(self, setup: Setup) -> None:
        self._start = setup.start
        self._loop = TutorialLoop(setup.robot, setup.target, start=setup.start)

    def reset(self) -> None:
        self._loop.reset(self._start)

    def run(self, steps: int) -> tuple[int, Float64]:
        final = self._loop.run(steps).astype(np.float64)
        return steps, final


class _Engine:
    """Scenes under PhysX's drive and nothing else: no gravity, so that the drive reaches what the PID reaches."""

    def __init__(self, case: str, setup: Setup, share: int) -> None:
        assert setup.robot.settings is not None
        spec = setup.scene(gravity=False)
        size, self._in_turn = ENGINES[case]
        self._substeps = setup.substeps
        builder = parse(spec)
        sizes = [min(size, share - first) for first in range(0, share, size)]
        self._packs = [Pack(builder, spec, count, system_size=size, isolates=False) for count in sizes]
        self._start, self._share = setup.start, share
        for pack in self._packs:
            stiffness, damping = setup.robot.settings.drive_stiffness, setup.robot.settings.drive_damping
            pack.write_drive(np.array(stiffness), np.array(damping), np.array(np.inf))
            pack.write_drive_target(np.tile(setup.target, (pack.size, 1)))

    def reset(self) -> None:
        for pack in self._packs:
            rows = np.tile(self._start, (pack.size, 1))
            pack.write_state(range(pack.size), rows, np.zeros_like(rows))

    def run(self, steps: int) -> tuple[int, Float64]:
        packs = self._packs
        if self._in_turn:
            for _ in range(steps):
                for pack in packs:
                    pack.step()
        else:
            for _ in range(steps // self._substeps):
                for pack in packs:
                    for _ in range(self._substeps):
                        pack.step()
        return steps * self._share, packs[0].read_qpos()[0]
