"""What workers are asked to do. A command is for all envs, and knows how to ask each worker for its part."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sim.loop.arrays import Command
from sim.workers.worker import LocalWorker, ProcessWorker

Worker = LocalWorker | ProcessWorker


class Request:
    """Base of all requests."""

    idle_limit = 10.0
    """Seconds for which a worker may sleep meanwhile: it may be building, with the caller's own code."""

    def send(self, worker: Worker, envs: slice) -> None:
        """Ask ``worker``, whose envs are ``envs``."""
        raise NotImplementedError

    def limit(self, envs: int) -> float:
        """Seconds that it takes for so many envs at the very most."""
        return 1e-2 * envs


@dataclass(frozen=True)
class Start(Request):
    """What a new process does unasked: build its loop."""

    def send(self, worker: Worker, envs: slice) -> None:
        """Do nothing."""

    def limit(self, envs: int) -> float:
        """Seconds that it takes at the very most: mostly imports, from a disk that may be slow."""
        return 60.0 + super().limit(envs)


@dataclass(frozen=True)
class Call(Request):
    """Call a method of the loop. Arrays among ``args`` have a row for each env; ``for_envs`` takes parts of others."""

    method: str
    args: tuple[Any, ...] = ()

    def send(self, worker: Worker, envs: slice) -> None:
        """Ask ``worker``, whose envs are ``envs``."""
        parts = (arg.for_envs(envs) if hasattr(arg, "for_envs") else arg[envs] for arg in self.args)
        worker.send(self.method, *parts)


@dataclass(frozen=True)
class Run(Request):
    """Run ticks under ``command`` (ticks, envs, dof)."""

    command: Command
    ticks: int
    substeps: int

    idle_limit = 0.7  # ticks do nothing but compute

    def send(self, worker: Worker, envs: slice) -> None:
        """Ask ``worker``, whose envs are ``envs``."""
        for name, rows in self.command._asdict().items():
            if rows is not None:
                for tick, row in zip(worker.ticks, rows, strict=False):
                    getattr(tick.command, name)[...] = row[envs]
        _, rate, feedforward = self.command
        worker.send_run(self.ticks, self.substeps, rate is not None, feedforward is not None)

    def limit(self, envs: int) -> float:
        """Seconds that it takes for so many envs at the very most: a sim step of one takes some 20 us."""
        return 1e-3 * self.ticks * self.substeps * envs

    def kept(self) -> Run:
        """Copy of it, which stays as it is when the caller writes to the arrays."""
        return replace(self, command=self.command.map(np.copy))
