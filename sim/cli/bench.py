"""``batchpid bench``: the runner beside the tutorial's loop and the bare engine, in one run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from sim.cli.optional import OptionalPath

if TYPE_CHECKING:
    from sim.benchmark.benchmark import Result
    from sim.benchmark.workload import Workload


@dataclass(frozen=True)
class Bench:
    """Measure the closed loop beside the tutorial's loop and the bare engine, and where its time goes.

    All cases move the same robots the same way, in turn, several rounds; rates are medians, ratios are medians of the
    rounds' ratios. Ends with an error if the robots of a case did not move as they should.
    """

    robot: str = "panda"
    """A bundled robot: panda or jaco2."""
    num_envs: int = 64
    """How many robots."""
    workers: int = 2
    """Processes that step them."""
    physics: Literal["accurate", "fast"] = "accurate"
    """Solver settings, the same in every case."""
    substeps: int = 20
    """Sim steps of one tick of the closed loop."""
    ticks: int = 100
    """Ticks of one measurement."""
    rounds: int = 5
    """How often each case is measured."""
    peers: bool = False
    """Also measure MuJoCo's rollout and Gymnasium's AsyncVectorEnv around the tutorial's loop, where installed."""
    json: OptionalPath = None
    """File for the figures, with the machine and the versions."""

    def run(self) -> None:
        """Run it."""
        from batchpid.validate import integer
        from sim import Robot
        from sim.benchmark.benchmark import CASES, measure_phases, measure_rates
        from sim.benchmark.peers import PEERS, installed_peers
        from sim.benchmark.workload import Workload
        from sim.cli import report
        from sim.cli.progress import bar

        workload = Workload(
            Robot.load(self.robot),
            num_envs=integer("num_envs", self.num_envs, 1, 1_000_000),
            workers=integer("workers", self.workers, 0, 1024),
            physics=self.physics,
            substeps=integer("substeps", self.substeps, 1, 1_000_000),
            ticks=integer("ticks", self.ticks, 1, 1_000_000),
            rounds=integer("rounds", self.rounds, 1, 1000),
        )
        peers = installed_peers() if self.peers else ()
        what = CASES | {name: PEERS[name].description for name in peers}
        advance = iter(bar("bench")(range(workload.rounds * len(what))))
        results = measure_rates(workload, progress=lambda case: next(advance, None), peers=peers)
        next(advance, None)  # the bar closes
        spent = measure_phases(workload)

        print(
            f"{workload.robot.name}, {workload.num_envs} envs, {workload.processes} processes, "
            f"physics {workload.physics!r}, {workload.substeps} substeps, {workload.rounds} rounds\n"
        )
        rows = [
            [case, f"{result.rate / 1e3:,.1f}", f"{ratio(results, case):.2f}", what[case]]
            for case, result in results.items()
        ]
        print(report.table(rows, ["case", "thousand steps/s", "closed loop / case", "what it is"], "lrrl"))
        print("\nclosed loop, microseconds per env step in a worker:")
        print(report.table([[f"{value:.2f}" for value in spent.values()]], list(spent), "r" * len(spent)))
        absent = sorted({peer.package for name, peer in PEERS.items() if self.peers and name not in peers})
        if absent:
            print(f"\nnot installed: {', '.join(absent)} (pip install 'batchpid[peers]')")
        if self.json is not None:
            self.json.parent.mkdir(parents=True, exist_ok=True)
            self.json.write_text(_as_json(workload, results, spent))
            print(f"\nfigures: {self.json}")


def ratio(results: dict[str, Result], case: str) -> float:
    """Closed loop over ``case``: the median of the paired rounds' ratios."""
    import statistics

    pairs = zip(results["closed loop"].rates, results[case].rates, strict=True)
    return statistics.median(ours / theirs for ours, theirs in pairs)


def _as_json(workload: Workload, results: dict[str, Result], spent: dict[str, float]) -> str:
    import json

    figures = {
        "setup": {
            "robot": workload.robot.name,
            "num_envs": workload.num_envs,
            "workers": workload.workers,
            "physics": workload.physics,
            "substeps": workload.substeps,
            "ticks": workload.ticks,
            "rounds": workload.rounds,
        },
        "machine": machine(),
        "cases": {
            case: {
                "env_steps_per_second": result.rates,
                "median": result.rate,
                "closed_loop_over_case": ratio(results, case),
                "final_qpos": result.final.tolist(),
            }
            for case, result in results.items()
        },
        "microseconds_per_env_step": spent,
    }
    return json.dumps(figures, indent=2) + "\n"


def machine() -> dict[str, Any]:
    """Hardware and versions that a figure depends on."""
    import os
    import platform
    from contextlib import suppress

    from batchpid.versions import package_versions

    processor = platform.processor() or platform.machine()
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                processor = line.partition(":")[2].strip()
                break
    return {
        "processor": processor,
        "cores": len(os.sched_getaffinity(0)),
        "system": platform.platform(),
        **package_versions(),
    }
