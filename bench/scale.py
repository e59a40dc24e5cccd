"""Expected rates of runners on clusters larger than those at hand: a simulation with measured costs (docs/notes.md).

    python bench/scale.py              # print the tables of the page; the same at every run
    python bench/scale.py --measure    # measure Ray's costs on this machine: half a minute, idle

A request goes to the nodes one after another, each works on it, and the answers queue for the caller's network card and
then for its thread; the next request waits for the last answer. A part of a request is served as in a queue with one
server and constant service time s: the k-th of the arrivals a_0 <= a_1 <= ... leaves at

    d_k = max(d_{k-1}, a_k) + s = max_{j <= k} (a_j - j s) + (k + 1) s                              (Lindley 1952)
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from time import perf_counter, sleep
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tabulate import tabulate

from batchpid.sim.loop.arrays import Arrays
from batchpid.sim.options import RunnerOptions
from batchpid.sim.workers.cluster import NODE_STEPS
from batchpid.sim.workers.node import SILENCE_LIMIT

NODES, CORES, ENVS = (2, 10, 100, 1000), 16, 64
"""Nodes of a cluster, cores of a node, envs of a core."""
DOF, SUBSTEPS = 9, 20
HOUR = 3600.0


@dataclass(frozen=True)
class Costs:
    """Costs in seconds, and bytes per second; those that are not measured are assumed."""

    env_step: float = 19.9e-6
    """A sim step of an env on one core: panda, "accurate"."""
    send: float = 0.16e-3
    """Request to a node, in the caller's thread."""
    send_rate: float = 1.3e9
    """Setpoints into the copies that are kept and into Ray's object store [B/s]."""
    receive: float = 0.09e-3
    """Answer of a node, in the caller's thread."""
    receive_rate: float = 8.0e9
    """Observations out of the object store and into the rollout [B/s]."""
    round_trip: float = 0.65e-3
    """Call to nothing, and back."""
    bandwidth: float = 1.25e9
    """Caller's network card, each way [B/s]; assumed: 10 Gbit/s."""
    jitter: float = 0.02
    """Mean excess of a worker's time over the fastest's, exponentially distributed; assumed."""
    slow: float = 1e-3
    """Share of requests in which a node takes twice the time; assumed."""
    detection: float = SILENCE_LIMIT
    """From the loss of a node to its replacement, at most."""
    restart: float = 5.0
    """Start of a node's processes and scenes; assumed."""


class Traffic(NamedTuple):
    """Bytes of an env and tick, from the caller and back."""

    down: int
    up: int


class Result(NamedTuple):
    """Expected rate of a runner, and shares of the time."""

    rate: float
    """[env steps/s]"""
    efficiency: float
    """Speed relative to the cores alone."""
    network: float
    """Share of the time in which the caller's network card receives, or sends, whichever is longer."""
    caller: float
    """Share of the time in which the caller's thread is busy."""
    stragglers: float
    """Share of the time between the mean node's and the slowest node's end."""
    losses: float
    """Share of the time lost with a node."""

    @property
    def bottleneck(self) -> str:
        """Resource that is used most."""
        shares = {"network": self.network, "caller": self.caller, "cores": self.efficiency}
        return max(shares, key=lambda name: shares[name])


def traffic(dof: int) -> Traffic:
    """Return the bytes of the arrays that travel, by their layout."""
    size = {
        name: int(np.prod(shape)) * np.dtype(kind).itemsize for name, (shape, kind) in Arrays.layout(1, 1, dof).items()
    }
    return Traffic(size["command.setpoint"], sum(size[name] for name in size if not name.startswith("command.")))


def departures(arrivals: NDArray[np.float64], service: float) -> NDArray[np.float64]:
    """Return when customers (..., k), sorted by arrival, leave a queue with one server."""
    k = np.arange(arrivals.shape[-1])
    return np.maximum.accumulate(arrivals - k * service, axis=-1) + (k + 1) * service


def simulate(nodes: int, ticks: int, costs: Costs, hours: float = 1.0, seed: int = 0) -> Result:
    """Return the expected result of a runner on ``nodes``, with ``ticks`` in a request and one node lost each hour."""
    rng = np.random.default_rng(seed)
    work = ticks * SUBSTEPS * ENVS * costs.env_step
    down, up = (each * ticks * ENVS * CORES for each in traffic(DOF))
    send, receive = costs.send + down / costs.send_rate, costs.receive + up / costs.receive_rate
    requests = max(1, min(int(hours * HOUR / (work + nodes * (send + receive))), 4_000_000 // nodes))

    # The slowest of a node's workers: the largest of CORES exponential variables, drawn by its distribution function.
    excess = -costs.jitter * np.log1p(-(rng.random((requests, nodes)) ** (1 / CORES)))
    took = work * (1 + excess) * (1 + (rng.random((requests, nodes)) < costs.slow))
    sent = np.arange(1, nodes + 1) * max(send, down / costs.bandwidth)
    answered = np.sort(sent + costs.round_trip + took, axis=1)
    received = departures(answered, up / costs.bandwidth)
    read = departures(np.maximum(received, sent[-1]), receive)[:, -1]

    checkpoint = RunnerOptions.checkpoint_steps or 0
    replay = rng.uniform(0, checkpoint, 1000).mean() * ENVS * costs.env_step
    lost = (costs.detection + costs.restart + replay) / HOUR
    share = 1 / (1 + lost)
    mean = read.mean()
    rate = share * nodes * CORES * ENVS * ticks * SUBSTEPS / mean
    return Result(
        rate,
        rate * costs.env_step / (nodes * CORES),
        share * nodes * max(up, down) / costs.bandwidth / mean,
        share * nodes * (send + receive) / mean,
        share * (answered[:, -1] - answered.mean(1)).mean() / mean,
        1 - share,
    )


def table(ticks: int, costs: Costs) -> str:
    """Return the results of all sizes as a table in Markdown."""
    rows = []
    for nodes in NODES:
        result = simulate(nodes, ticks, costs)
        shares = [f"{100 * share:.0f} %" for share in result[1:]]
        rows.append([f"{nodes:,}", f"{result.rate / 1e6:,.1f}", *shares, result.bottleneck])
    names = ("nodes", "million env-steps/s", "efficiency", "network", "caller", "stragglers", "losses", "most used")
    return tabulate(rows, names, tablefmt="github", colalign=["right"] * 7 + ["left"], disable_numparse=True)


def report(costs: Costs) -> str:
    """Return the tables of docs/notes.md."""
    piece = NODE_STEPS // (SUBSTEPS * ENVS)
    fast = Costs(bandwidth=10 * costs.bandwidth)
    cases = (
        (f"rollout, {piece} ticks in a request, 10 Gbit/s", piece, costs),
        (f"rollout, {piece} ticks in a request, 100 Gbit/s", piece, fast),
        ("step, one tick in a request, 10 Gbit/s", 1, costs),  # nearly the same at 100 Gbit/s
    )
    return "\n\n".join(f"**{title}**\n\n{table(ticks, case)}" for title, ticks, case in cases)


def measure(calls: int = 30, **connection: Any) -> str:
    """Return Ray's costs on this machine, the lowest of several: calls with the arrays of one node and piece.

    ``connection`` are arguments of ``ray.init``; by default it starts a cluster.
    """
    import ray

    ticks = NODE_STEPS // (SUBSTEPS * ENVS)
    size = traffic(DOF)
    ray.init(**(connection or {"address": "local", "num_cpus": 1, "include_dashboard": False}), log_to_driver=False)

    @ray.remote
    class Node:
        def execute(self, setpoints: NDArray[np.uint8], count: int) -> NDArray[np.uint8]:
            return np.zeros(count, np.uint8)

    node, times = Node.remote(), {}
    for name, count in {"small": 1, "large": ticks * ENVS * CORES}.items():
        setpoints, shared = np.zeros((2, count * size.down), np.uint8)
        rollout = np.zeros(count * size.up, np.uint8)
        found = []
        for _ in range(calls):
            begin = perf_counter()
            shared[:] = setpoints.copy()  # kept for a replay, and for a recorder
            answer = node.execute.remote(setpoints, len(rollout))
            sent = perf_counter()
            ray.wait([answer])
            sleep(0.02)
            waited = perf_counter()
            rows = ray.get(answer)
            for _ in range(2):  # into the shared arrays, and into the rollout
                rollout[:] = rows
            found.append((sent - begin, perf_counter() - waited))
        times[name] = np.min(found, axis=0)
    trips = []
    for _ in range(calls):
        begin = perf_counter()
        ray.get(node.execute.remote(np.zeros(1, np.uint8), 1))
        trips.append(perf_counter() - begin)
    ray.shutdown()
    (send, receive), (longer_send, longer_receive) = times["small"], times["large"]
    count = ticks * ENVS * CORES
    send_rate, receive_rate = count * size.down / (longer_send - send), count * size.up / (longer_receive - receive)
    return (
        f"send {1e3 * send:.2f} ms, {send_rate / 1e9:.1f} GB/s; receive {1e3 * receive:.2f} ms, "
        f"{receive_rate / 1e9:.1f} GB/s; round trip {1e3 * min(trips):.2f} ms"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Expected rates of runners on clusters.")
    parser.add_argument("--measure", action="store_true", help="measure Ray's costs on this machine")
    print(measure() if parser.parse_args().measure else report(Costs()))
