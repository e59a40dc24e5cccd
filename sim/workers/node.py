"""Machines of a Ray cluster as workers of a pool.

Ray finds the machines, starts one actor on each and carries the messages. The actor has a pool of
worker processes for a slice of the envs. It is lost with its machine, with any of its workers, or
when it does not answer in time; the caller's pool then replaces it, here or on another machine, as
it replaces a worker process.
"""

from __future__ import annotations

import logging
import os
import pickle
from typing import Any

from batchpid.arrays.trees import leaves
from batchpid.errors import InvalidArgumentError, MissingDependencyError
from batchpid.sim.loop.arrays import Arrays
from batchpid.sim.loop.loop import Failure, failed
from batchpid.sim.workers.requests import Request, SharedArrays, Start, split
from batchpid.sim.workers.worker import Worker, WorkerLost, pickled

NODE_STEPS = 25_000
"""Sim steps times envs of a worker in one request to its node, at most, unless a tick has more:
half a second.
"""


class Node:
    """Pool of the envs of one machine, as a Ray actor.

    ``message`` is pickled: the type of the pool, the :class:`Start` of its envs, and the most ticks
    of a request.
    """

    def __init__(self, message: bytes, workers: int) -> None:
        self._message, self._workers = message, workers
        self._pool: Any = None

    def execute(self, request: Request) -> tuple[object, Arrays | None]:
        """Execute a request, which has the part of this node's envs; the first one starts the pool.

        Return its result, or a failure, and the output (ticks, envs, ...); None where the request
        does not change the observation.
        """
        try:
            if self._pool is None:
                pool_type, start, ticks = pickle.loads(self._message)
                options = start.options.changed(workers=self._workers, cluster=None)
                self._pool = pool_type(options, start.envs, ticks)
                # The caller replaces a node that has lost a worker: it keeps the requests to replay.
                self._pool.max_losses = 1
                self._pool.open()
                return None, None
            outcome = self._pool.run(request)
        except Exception as error:
            # The caller's own words follow the cause of a loss.
            if isinstance(error, WorkerLost):
                error = WorkerLost(str(error.__cause__))
            return failed(error).portable("node"), None
        self._pool.replay.start_from(None)
        if outcome.failure is not None:
            return outcome.failure, None
        arrays = None
        if request.ticks:
            arrays = self._pool.arrays.at(slice(request.ticks))
        return outcome.result, arrays


class Cluster:
    """Machines for ``num_envs`` envs, which Ray chooses.

    Raises
    ------
    InvalidArgumentError
        The cluster has no machine with a CPU.
    MissingDependencyError
        The package ``ray`` is missing.
    """

    def __init__(self, num_envs: int) -> None:
        self.ray: Any = _connected()
        """The module."""
        resources = [node["Resources"] for node in self.ray.nodes() if node["Alive"]]
        counts = [int(machine.get("CPU", 0)) for machine in resources]
        cpus = sorted(counts, reverse=True)[:num_envs]

        def workers(machines: int) -> int:
            return machines * cpus[machines - 1]

        # The largest machines, each with as many workers as the smallest of them has CPUs: as many
        # machines as give the most workers in all.
        count = max(range(1, len(cpus) + 1), key=workers, default=0)
        self.workers: int = cpus[count - 1] if count else 0
        """Workers on each machine."""
        if not self.workers:
            remedy = "add a machine, or start Ray on one with CPUs"
            raise InvalidArgumentError("cluster", "has no machine with a CPU", remedy=remedy)
        self.slices = split(num_envs, count)
        """Envs of each node."""


def _connected() -> Any:
    """Return the module ray, connected to the cluster: by the caller, or by Ray's own rules."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # without it, a warning
    try:
        import ray
    except ImportError:
        raise MissingDependencyError("ray", "cluster='ray'", "ray") from None
    if not ray.is_initialized():
        logging.getLogger("ray").setLevel(logging.ERROR)
        # Ray takes RAY_ADDRESS, or a cluster that runs here, or starts one.
        ray.init(log_to_driver=False, configure_logging=False)
    return ray


class NodeWorker(Worker):
    """Caller's end of a node."""

    def __init__(
        self,
        start: Start,
        shared: SharedArrays,
        cluster: Cluster,
        pool_type: type,
    ) -> None:
        super().__init__(start, shared)
        self._cluster = cluster
        ticks = len(shared.arrays.observation.ok)
        self._message = pickled((pool_type, start, ticks))
        self._actor: Any = None
        self._cpus = cluster.workers

    def open(self) -> None:
        actor_type = self._cluster.ray.remote(Node).options(
            num_cpus=self._cpus,
            scheduling_strategy="SPREAD",
        )
        self._actor = actor_type.remote(self._message, self._cluster.workers)
        # A node that replaces a lost one reserves no CPUs, which the lost one has until it has ended.
        self._cpus = 0

    def send(self, request: Request) -> None:
        self._seconds = self._limit(request)
        self._call = self._actor.execute.remote(request.for_envs(self.envs))

    def receive(self) -> object:
        exceptions = self._cluster.ray.exceptions
        try:
            result, arrays = self._cluster.ray.get(self._call, timeout=self._seconds)
        except exceptions.RayError as error:  # one of them is that the time is up
            raise self._lost(f"is lost ({type(error).__name__}: {error})") from error
        if arrays is not None:
            ticks = slice(len(arrays.observation.ok))
            part = self._shared.arrays.at((ticks, self.envs))
            # The caller has the command.
            for table, rows in zip(leaves(part[1:]), leaves(arrays[1:]), strict=True):
                table[...] = rows
        if isinstance(result, Failure) and isinstance(result.error, WorkerLost):
            raise self._lost(f"lost a worker: {result.error}")
        return result

    def close(self) -> None:
        actor, self._actor = self._actor, None
        if actor is not None and self._cluster.ray.is_initialized():
            self._cluster.ray.kill(actor)

    def _lost(self, cause: str) -> WorkerLost:
        return WorkerLost(f"node {self._start.label} {cause}")
