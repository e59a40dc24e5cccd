"""``batchpid bench``: the speed of the runner, paired with the tutorial's loop and the bare engine."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sim.cli import flags

if TYPE_CHECKING:
    from sim.benchmark.benchmark import Result
    from sim.benchmark.workload import Workload


@dataclass(frozen=True)
class BenchCommand:
    """Measure the speed of the closed loop and its phases, of the tutorial's loop and of the bare engine.

    All cases move the same robots the same way, in turn, in several rounds; rates are medians, ratios are medians of
    the rounds' ratios. An error is raised if the robots of a case do not move as they should.
    """

    robot: flags.RobotName = "panda"
    num_envs: flags.NumEnvs = 64
    physics: flags.Physics = "accurate"
    substeps: int = 20
    """Sim steps of a tick of the closed loop."""
    ticks: int = 100
    """Ticks of one measurement."""
    rounds: int = 5
    """Measurements of each case."""
    peers: flags.Switch = False
    """Measure MuJoCo, and Gymnasium's AsyncVectorEnv around the tutorial's loop, too, where installed."""
    workers: flags.Workers = None
    missing_meshes: flags.MissingMeshes = "error"
    out: flags.OptionalPath = None
    """Figures to write, with the machine and the versions: .json."""

    def run(self) -> None:
        """Run the command."""
        import json
        import os

        from batchpid.files import write_atomically
        from batchpid.validate import integer
        from sim import Robot
        from sim.benchmark.benchmark import CASES, measure_phases, measure_rates
        from sim.benchmark.peers import PEERS, installed_peers
        from sim.benchmark.workload import Workload
        from sim.cli import report
        from sim.cli.progress import bar

        out = flags.output_path("out", self.out, (".json",))
        workers = len(os.sched_getaffinity(0)) if self.workers is None else self.workers
        workload = Workload(
            Robot.load(self.robot, missing_meshes=self.missing_meshes),
            num_envs=integer("num_envs", self.num_envs, 1, 1_000_000),
            workers=integer("workers", workers, 0, 1024),
            physics=self.physics,
            substeps=integer("substeps", self.substeps, 1, 1_000_000),
            ticks=integer("ticks", self.ticks, 1, 1_000_000),
            rounds=integer("rounds", self.rounds, 1, 1000),
        )
        peers = installed_peers() if self.peers else ()
        descriptions = CASES | {name: PEERS[name].description for name in peers}
        advance = iter(bar("bench")(range(workload.rounds * len(descriptions))))
        results = measure_rates(workload, progress=lambda case: next(advance, None), peers=peers)
        next(advance, None)  # close the bar
        spent = measure_phases(workload)

        print(
            f"{workload.robot.name}, {workload.num_envs} envs, {workload.processes} processes, "
            f"physics {workload.physics!r}, {workload.substeps} substeps, {workload.rounds} rounds\n"
        )
        rows = [
            [case, f"{result.rate / 1e3:,.1f}", f"{ratio(results, case):.2f}", descriptions[case]]
            for case, result in results.items()
        ]
        print(report.table(rows, ["case", "thousand env-steps/s", "closed loop / case", "description"], "lrrl"))
        print("\nclosed loop, microseconds per env step in a worker:")
        print(report.table([[f"{value:.2f}" for value in spent.values()]], list(spent), "r" * len(spent)))
        absent = sorted({peer.package for name, peer in PEERS.items() if self.peers and name not in peers})
        if absent:
            print(f"\nnot installed: {', '.join(absent)} (pip install 'batchpid[peers]')")
        if out is not None:
            write_atomically(out, json.dumps(figures(workload, results, spent), indent=2) + "\n")
            print(f"\nwritten: {out}")


def ratio(results: dict[str, Result], case: str) -> float:
    """Return the rate of the closed loop over that of ``case``: the median of the rounds' ratios."""
    import numpy as np

    return float(np.median(np.divide(results["closed loop"].rates, results[case].rates)))


def figures(workload: Workload, results: dict[str, Result], spent: dict[str, float]) -> dict[str, Any]:
    """Return all that was measured, and on which machine, for JSON."""
    return {
        "setup": vars(workload) | {"robot": workload.robot.name},
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


def machine() -> dict[str, Any]:
    """Return the hardware and the versions that figures depend on."""
    import os
    import platform
    import re
    from contextlib import suppress

    from batchpid.versions import package_versions

    processor = platform.processor() or platform.machine()
    with suppress(OSError):
        found = re.search(r"^model name\s*: (.*)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
        processor = found[1] if found else processor
    return {
        "processor": processor,
        "cores": len(os.sched_getaffinity(0)),
        "system": platform.platform(),
        **package_versions(),
    }
