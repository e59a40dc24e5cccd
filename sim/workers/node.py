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
from collections import Counter
from collections.abc import Callable
from typing import Any, NamedTuple

from batchpid.errors import InvalidArgumentError, MissingDependencyError, WorkerError
from batchpid.sim.loop.arrays import Arrays
from batchpid.sim.loop.loop import Failure
from batchpid.sim.options.groups import Ray
from batchpid.sim.workers.exchange import SharedArrays
from batchpid.sim.workers.requests import Build, Request, Start, split_in_shares
from batchpid.sim.workers.worker import Worker, WorkerLost, pickled

NODE_STEPS = 25_000
"""Sim steps times envs of a worker in one request to its node, at most, unless a tick has more:
half a second.
"""


class Machine(NamedTuple):
    """Machine of a cluster, and the largest number of workers on it."""

    node_id: str
    address: str
    workers: int


class NodeInfo(NamedTuple):
    """Machine of a cluster, and the processes that run some of a runner's envs there."""

    address: str
    """Address of the machine."""
    envs: slice
    """Envs of the runner."""
    pid: int
    """Process that holds the pool of workers."""
    pids: tuple[int, ...]
    """Worker processes."""


class Answer(NamedTuple):
    """Answer of a node to a request."""

    result: Any
    """Result of the request."""
    failure: Failure | None = None
    """Failure of the pool, in place of the result."""
    arrays: Arrays | None = None
    """Output (ticks, envs, ...) of the ticks that were completed, if the request changes the
    observation.
    """


class Node:
    """Pool of the envs of one machine, as a Ray actor."""

    def __init__(self) -> None:
        self._pool: Any = None

    def start(self, message: bytes, workers: int, address: str) -> Answer:
        """Start the pool; return a :class:`NodeInfo`.

        ``message`` is pickled: the type of the pool, the :class:`Start` of its envs, and the most
        ticks of a request.
        """
        pool_type, start, ticks = pickle.loads(message)

        def open_pool() -> Answer:
            options = start.options.changed(workers=workers, cluster=None)
            self._pool = pool_type(options, start.params, start.envs, ticks)
            # The caller replaces a node that has lost a worker: it keeps the requests to replay.
            self._pool.max_losses = 1
            self._pool.open()
            pids = tuple(worker.pid for worker in self._pool.workers)
            return Answer(NodeInfo(address, start.envs, os.getpid(), pids))

        return _answer(open_pool)

    def execute(self, request: Request) -> Answer:
        """Execute a request, which has the part of this node's envs."""

        def run() -> Answer:
            outcome = self._pool.run(request)
            self._pool.start_replay_from(None)
            if outcome.num_ticks:
                arrays = self._pool.arrays.at(slice(outcome.num_ticks))
            else:
                arrays = None
            if outcome.failure is not None:
                return Answer(None, outcome.failure.portable(), arrays)
            return Answer(request.join(outcome.results), None, arrays)

        return _answer(run)


def _answer(act: Callable[[], Answer]) -> Answer:
    try:
        return act()
    except WorkerLost as error:
        return Answer(None, Failure(0, 0, 0, WorkerLost(str(error.__cause__))))
    except Exception as error:
        return Answer(None, Failure.of(error).portable())


class Cluster:
    """Machines of ``num_envs`` envs.

    Raises
    ------
    InvalidArgumentError
        The cluster has no machine with enough CPUs.
    MissingDependencyError
        The package ``ray`` is missing.
    """

    def __init__(self, options: Ray, num_envs: int) -> None:
        self.ray: Any = _connect(options)
        """The module."""
        self.options = options
        machines = self._machines()[: options.nodes]
        if not machines:
            least = options.cpus_per_node or 1
            remedy = "lower cpus_per_node, or add larger machines"
            raise InvalidArgumentError("cluster", f"has no machine of {least} CPUs", remedy=remedy)
        parts = split_in_shares(num_envs, [machine.workers for machine in machines])
        used = [
            (envs, machine)
            for envs, machine in zip(parts, machines, strict=True)
            if envs.stop > envs.start
        ]
        self.slices = [envs for envs, _ in used]
        """Envs of each node."""
        self.widest = max(-(-(envs.stop - envs.start) // machine.workers) for envs, machine in used)
        """Most envs of one worker."""
        self.machines = [machine for _, machine in used]
        """Machine of each node."""
        self._losses: Counter[str] = Counter()

    def replace(self, index: int) -> None:
        """Choose another machine for a lost node, if there is one that has lost fewer. Raises
        WorkerError for none.
        """
        self._losses[self.machines[index].node_id] += 1
        nodes = Counter(machine.node_id for machine in self.machines)
        candidates = self._machines()
        if not candidates:
            raise WorkerError(
                f"the cluster has no machine left for node {index}; restore a snapshot in a new"
                " Runner"
            )
        self.machines[index] = min(
            candidates, key=lambda one: (self._losses[one.node_id], nodes[one.node_id])
        )

    def _machines(self) -> list[Machine]:
        """Return the machines, in descending order of CPUs."""
        least = self.options.cpus_per_node
        machines = []
        for node in self.ray.nodes():
            cpus = int(node["Resources"].get("CPU", 0))
            if node["Alive"] and cpus >= (least or 1):
                machines.append(Machine(node["NodeID"], node["NodeManagerAddress"], least or cpus))
        return sorted(
            machines, key=lambda machine: (-machine.workers, machine.address, machine.node_id)
        )


def _connect(options: Ray) -> Any:
    """Return the module ray, connected to the cluster."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # without it, a warning
    try:
        import ray
    except ImportError:
        raise MissingDependencyError("ray", "cluster='ray'", "ray") from None
    if ray.is_initialized():
        return ray
    logging.getLogger("ray").setLevel(logging.ERROR)
    address = options.address or os.environ.get("RAY_ADDRESS") or "auto"
    try:
        if address != "local":
            ray.init(address, log_to_driver=False, configure_logging=False)
    except ConnectionError:
        if address != "auto":
            raise
    if not ray.is_initialized():
        cpus = len(os.sched_getaffinity(0))
        ray.init(
            "local",
            num_cpus=cpus,
            include_dashboard=False,
            log_to_driver=False,
            configure_logging=False,
        )
    return ray


class NodeWorker(Worker):
    """Caller's end of a node."""

    def __init__(
        self, start: Start, shared: SharedArrays, cluster: Cluster, pool_type: Any
    ) -> None:
        super().__init__(start, shared)
        self._cluster, self._arrays = cluster, Arrays.from_fields(shared.arrays)
        ticks = len(self._arrays.observation.ok)
        self._message = pickled((pool_type, start, ticks), start.options)
        self._actor: Any = None
        self._cpus = self._machine.workers  # to reserve
        self.info: NodeInfo | None = None
        """Known when the node has started."""

    def open(self) -> None:
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        if not self._cpus:  # it replaces a lost one, which has the CPUs until it has ended
            self._cluster.replace(self._start.index)
        actor_type = self._cluster.ray.remote(Node).options(
            num_cpus=self._cpus,
            scheduling_strategy=NodeAffinitySchedulingStrategy(self._machine.node_id, soft=False),
            runtime_env=self._cluster.options.runtime_env,
        )
        self._actor = actor_type.remote()
        self._cpus = 0

    def send(self, request: Request) -> None:
        limit = self._step_limit * (request.ticks or 1) * request.substeps
        self._limit = limit + self._timeout + request.patience
        if isinstance(request, Build):
            machine = self._machine
            self._call = self._actor.start.remote(self._message, machine.workers, machine.address)
        else:
            self._call = self._actor.execute.remote(request.for_envs(self.envs))

    def receive(self) -> Any:
        exceptions = self._cluster.ray.exceptions
        try:
            result, failure, arrays = self._cluster.ray.get(self._call, timeout=self._limit)
        except exceptions.GetTimeoutError as error:
            raise self._lost("is stuck: no answer in time") from error
        except exceptions.RayError as error:
            raise self._lost(f"died ({type(error).__name__}: {error})") from error
        if failure is not None and isinstance(failure.error, WorkerLost):
            raise self._lost(f"lost a worker: {failure.error}")
        if arrays is not None:
            tick = len(arrays.observation.ok)
            for ours, theirs in zip(self._arrays[1:], arrays[1:], strict=True):
                tables: Any = zip(ours, theirs, strict=True)
                for table, rows in tables:
                    if table is not None:
                        table[:tick, self.envs] = rows
        if failure is not None:
            return failure.of_worker(f"node {self.label}")
        if isinstance(result, NodeInfo):
            self.info = result
        return result

    def close(self) -> None:
        actor, self._actor = self._actor, None
        if actor is not None and self._cluster.ray.is_initialized():
            self._cluster.ray.kill(actor)

    @property
    def _machine(self) -> Machine:
        return self._cluster.machines[self._start.index]

    def _lost(self, cause: str) -> WorkerLost:
        return WorkerLost(f"node {self.label} on {self._machine.address} {cause}")
