"""Time a rollout on a Ray cluster of this machine against the local pool, in pairs.

    python bench/cluster.py

64 pandas at 20 substeps a tick: two workers of the local pool, one node with two workers, and two nodes with one worker
each, in turns; the ratios are medians over the turns. Then single steps. Prints a table.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import tyro

from batchpid.sim import Ray, Robot, Runner

SMALL = {"object_store_memory": 100 << 20, "include_dashboard": False}


@contextmanager
def machines(workers: int) -> Iterator[str]:
    """Start Ray nodes on this machine, with CPUs for all runners; yield the address of their cluster."""
    import ray
    from ray.cluster_utils import Cluster

    head = {"num_cpus": 0, "_system_config": {"worker_niceness": 0}, **SMALL}  # as the local pool
    cluster = Cluster(initialize_head=True, head_node_args=head)
    try:
        for cpus in (workers + 1, *[1] * (workers - 1)):
            cluster.add_node(num_cpus=cpus, **SMALL)
        yield cluster.address
    finally:
        ray.shutdown()
        cluster.shutdown()


@dataclass(frozen=True)
class Bench:
    """Options."""

    num_envs: int = 64
    workers: int = 2
    turns: int = 10
    ticks: int = 160
    """Ticks of a rollout, of 20 sim steps each."""
    steps: int = 100
    """Single ticks for the latency."""

    def run(self, address: str) -> None:
        """Print the table, on the cluster at ``address``."""
        robot = Robot.load("panda")
        setpoints = np.tile(robot.target, (self.ticks, 1))
        where: dict[str, dict[str, Any]] = {
            f"local, workers: {self.workers}": {"workers": self.workers},
            f"one node, workers: {self.workers}": {"cluster": Ray(address, nodes=1, cpus_per_node=self.workers)},
            f"one worker each, nodes: {self.workers}": {"cluster": Ray(address, nodes=self.workers, cpus_per_node=1)},
        }
        with ExitStack() as stack:
            runners = {
                name: stack.enter_context(Runner(robot, self.num_envs, params=robot.params(), **options))
                for name, options in where.items()
            }
            rollouts, latencies = (np.zeros((turns, len(runners))) for turns in (self.turns, self.steps))
            for turn in range(-1, self.turns):  # the first is a warm-up
                for column, runner in enumerate(runners.values()):
                    runner.reset()
                    began = time.perf_counter()
                    qpos = runner.rollout(setpoints).qpos
                    rollouts[turn, column] = time.perf_counter() - began
                    assert np.abs(qpos[-1] - qpos[0]).max() > 0.01, "the robots did not move"
            for turn in range(self.steps):
                for column, runner in enumerate(runners.values()):
                    began = time.perf_counter()
                    runner.step(setpoints[0], substeps=1)
                    latencies[turn, column] = time.perf_counter() - began - runner.work_seconds.max()
        ratios = np.median(rollouts / rollouts[:, :1], axis=0)
        print(
            f"| | rollout, {self.ticks} ticks | ratio | ratio to one node | messages of a step |\n|---|---|---|---|---|"
        )
        apart = np.median(rollouts / rollouts[:, 1:2], axis=0)
        for column, name in enumerate(runners):
            seconds, message = np.median(rollouts[:, column]), 1e3 * np.median(latencies[:, column])
            print(f"| {name} | {seconds:.2f} s | {ratios[column]:.3f} | {apart[column]:.3f} | {message:.2f} ms |")


if __name__ == "__main__":
    bench = tyro.cli(Bench)
    with machines(bench.workers) as address:
        bench.run(address)
