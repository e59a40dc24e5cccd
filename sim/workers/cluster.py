"""Machines of a Ray cluster as workers of a pool.

Ray finds the machines, starts a process on each and carries the messages. That process holds a pool of workers for a
slice of the envs (:mod:`batchpid.sim.workers.node`). It is lost with its machine, with any of its workers, or when it
does not answer; the caller's pool then replaces it, here or on another machine, as it replaces a worker process.
"""

from __future__ import annotations

import logging
import os
import socket
from collections import Counter
from typing import Any, NamedTuple

import batchpid as bp
from batchpid.arrays.array_types import Document
from batchpid.errors import InvalidArgumentError, MissingDependencyError, WorkerError
from batchpid.sim.options import RunnerOptions
from batchpid.sim.processes.background import BACKGROUND
from batchpid.sim.ray_options import ClusterWarning, Ray
from batchpid.sim.workers.placement import split_in_shares

NODE_STEPS = 25_000
"""Sim steps times envs of a worker in one request to its node, at most, unless a tick has more: half a second."""
_JOIN = (
    "if it has a token, set RAY_AUTH_MODE=token, and RAY_AUTH_TOKEN or ~/.ray/auth_token to that token, for this "
    "program and on every machine; if this machine does not belong to it, run ray start --address=... here"
)
_PROBE_LIMIT = 2.0  # seconds for a connection to a machine
_LATENCY_RUNS = 50  # requests over which time and work are compared
_QUIET = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0"}


class Machine(NamedTuple):
    """Machine of a cluster, and the workers that it can have."""

    node_id: str
    address: str
    port: int
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
    processor: str
    """Model of the processor."""
    digest: str
    """Digest of the canonical episode (:func:`batchpid.sim.workers.requests.canonical_digest`)."""


class Cluster:
    """Machines of a runner's envs.

    Parameters
    ----------
    options, params
        Of the runner.
    pool_type
        Type of the pools of the machines.
    messages
        Warnings for the caller of the runner, by category.

    Raises
    ------
    InvalidArgumentError
        There is no such cluster, or it has no machine with enough CPUs.
    MissingDependencyError
        The package ``ray`` is missing.
    """

    def __init__(
        self, options: RunnerOptions, params: bp.PIDParams, pool_type: Any, messages: dict[type[Warning], str]
    ) -> None:
        assert options.cluster is not None
        self.options, self.messages, self.pool_type = options.cluster, messages, pool_type
        self.canonical = params.for_envs(slice(0, 1))
        """Params of the canonical episode."""
        self.ray = BACKGROUND.call(lambda: _connect(self.options))
        """The module."""
        machines = self._machines()[: self.options.nodes]
        if not machines:
            least = self.options.cpus_per_node or 1
            raise InvalidArgumentError(
                "cluster",
                f"has no machine of {least} CPUs",
                remedy="lower cpus_per_node, or add larger machines",
            )
        if self.options.placement == "PACK":
            needed = options.num_envs
            enough = [sum(machine.workers for machine in machines[:count]) >= needed for count in range(len(machines))]
            machines = machines[: max(1, enough.index(True))] if True in enough else machines
        parts = split_in_shares(options.num_envs, [machine.workers for machine in machines])
        used = [(envs, machine) for envs, machine in zip(parts, machines, strict=True) if envs.stop > envs.start]
        self.slices = [envs for envs, _ in used]
        """Envs of each node."""
        self.widest = max(-(-(envs.stop - envs.start) // machine.workers) for envs, machine in used)
        """Most envs of one worker."""
        self._homes = dict(enumerate(machine for _, machine in used))
        self._has_started: set[int] = set()
        self._failures: Counter[str] = Counter()
        self._unlike: set[str] = set()
        self._reference: NodeInfo | None = None
        self._runs, self._seconds, self._work = 0, 0.0, 0.0

    def place(self, index: int) -> tuple[Machine, int]:
        """Return the machine for the envs of a node, and the CPUs to reserve: none for a replacement.

        Raises WorkerError if no machine is left.
        """
        if index not in self._has_started:
            self._has_started.add(index)
            return self._homes[index], self._homes[index].workers
        left = [machine for machine in self._machines() if machine.node_id not in self._unlike]
        if not left:
            raise WorkerError(f"the cluster has no machine left for node {index}; restore a snapshot in a new Runner")
        others = Counter(machine.node_id for node, machine in self._homes.items() if node != index)
        machine = min(left, key=lambda one: (self._failures[one.node_id], others[one.node_id], -one.workers))
        self._homes[index] = machine
        return machine, 0

    def note_failure(self, machine: Machine) -> None:
        """Prefer other machines: a node has not started on this one."""
        self._failures[machine.node_id] += 1

    def admit(self, info: NodeInfo, machine: Machine) -> None:
        """Check that a new node rounds as the first one does. Raises InvalidArgumentError if not."""
        if self._reference is None:
            self._reference = info
        first = self._reference
        if info.digest == first.digest:
            return
        problem = (
            f"has machines that do not round alike: {first.address} ({first.processor}) and {info.address} "
            f"({info.processor})"
        )
        if not self.options.accept_differences:
            self._unlike.add(machine.node_id)
            raise InvalidArgumentError(
                "cluster",
                problem,
                remedy="choose machines with equal processors and packages, or pass Ray(accept_differences=True)",
            )
        self.messages[ClusterWarning] = f"the cluster {problem}; results depend on the machine that runs an env"

    def note_time(self, seconds: float, work: float) -> None:
        """Note how long a request took, and its work on the machine."""
        self._runs, self._seconds, self._work = self._runs + 1, self._seconds + seconds, self._work + work
        if self._runs == _LATENCY_RUNS and self._seconds > 2 * self._work:
            each, part = 1e3 * self._seconds / self._runs, 100 * self._work / self._seconds
            self.messages[ClusterWarning] = (
                f"a request to the cluster takes {each:.1f} ms, of which {part:.0f} % are simulation and the rest "
                "messages; use rollout(), more envs or more substeps, or cluster=None"
            )

    def _machines(self) -> list[Machine]:
        """Return the machines that answer, those with most CPUs first."""
        wanted, found = self.options.cpus_per_node, []
        for node in BACKGROUND.call(self.ray.nodes):
            cpus = int(node["Resources"].get("CPU", 0))
            machine = Machine(node["NodeID"], node["NodeManagerAddress"], node["NodeManagerPort"], wanted or cpus)
            # Ray takes a quarter of a minute to notice that a machine is gone.
            if node["Alive"] and cpus >= (wanted or 1) and _answers(machine.address, machine.port):
                found.append(machine)
        return sorted(found, key=lambda machine: (-machine.workers, machine.address, machine.node_id))


def _connect(options: Ray) -> Any:
    """Return the module ray, connected to the cluster."""
    for name, value in _QUIET.items():
        os.environ.setdefault(name, value)
    try:
        import ray
    except ImportError:
        raise MissingDependencyError("ray", "cluster='ray'", "ray") from None
    if ray.is_initialized():
        return ray
    logging.getLogger("ray").setLevel(logging.ERROR)
    quiet: Document = {"log_to_driver": False, "configure_logging": False}
    address = options.address or os.environ.get("RAY_ADDRESS") or "auto"
    host, _, port = address.rpartition(":")
    if host and not (port.isdecimal() and _answers(host, int(port))):
        raise InvalidArgumentError(
            "cluster",
            f"does not answer at {address}",
            remedy="start it with ray start --head, or leave the address out",
        )
    try:
        if address != "local":
            ray.init(address, **quiet)
    except (ConnectionError, ray.exceptions.RayError) as error:  # Ray says in its log alone that a token is wrong
        if address != "auto" or not isinstance(error, ConnectionError):
            raise InvalidArgumentError("cluster", f"at {address} cannot be joined: {error}", remedy=_JOIN) from error
    if not ray.is_initialized():
        ray.init("local", num_cpus=len(os.sched_getaffinity(0)), include_dashboard=False, **quiet)
    return ray


def _answers(host: str, port: int) -> bool:
    """Return True if a process listens there."""
    try:
        socket.create_connection((host, port), _PROBE_LIMIT).close()
    except OSError:
        return False
    return True
