"""``batchpid bench``: the speed of the runner, paired with the tutorial's loop and the bare engine."""

from __future__ import annotations

import json
import os
import platform
import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from batchpid.checks.validate import integer
from batchpid.io.files import write_atomically
from batchpid.io.versions import package_versions
from batchpid.sim import Robot
from batchpid.sim.cli import flags
from batchpid.sim.cli.outputs import Outputs
from batchpid.sim.cli.progress import bar
from batchpid.sim.runner_keywords import DEFAULT_ENGINE


@dataclass(frozen=True)
class BenchCommand:
    """Measure the speed of the closed loop and its phases, of the tutorial's loop and of the bare engine.

    All cases move the same robots the same way, in turn, in several rounds; rates are medians, ratios are medians of
    the rounds' ratios, of all processes together and per process. An error is raised if the robots of a case do not
    move as they should.
    """

    robot: flags.RobotName = "panda"
    num_envs: flags.NumEnvs = 64
    engine: flags.Engine = DEFAULT_ENGINE
    """Engine of the closed loops and of the bare engine; the tutorial's loop is in SAPIEN."""
    physics: flags.Physics = "accurate"
    substeps: int = 20
    """Sim steps of a tick of the closed loop."""
    ticks: int = 100
    """Ticks of one measurement."""
    rounds: int = 5
    """Measurements of each case."""
    peers: flags.Switch = False
    """Measure MuJoCo, with the closed loop and alone, and Gymnasium's AsyncVectorEnv around the tutorial's loop, too,
    where installed."""
    xla: flags.Switch = False
    """Measure the closed loop in XLA, too."""
    workers: flags.Workers = None
    meshes: flags.Meshes = field(default_factory=flags.MeshOptions)
    out: flags.OptionalPath = None
    """Figures to write, with the machine and the versions: .json."""
    force: flags.Force = False

    imports = ("batchpid.sim.benchmark.benchmark",)

    def run(self) -> None:
        """Run the command."""
        from batchpid.sim.benchmark.benchmark import OURS, cases_in, measure_phases, measure_rates
        from batchpid.sim.benchmark.peers import PEERS, installed_peers
        from batchpid.sim.benchmark.workload import Workload
        from batchpid.sim.cli.report import table
        from batchpid.sim.engine.engines import load_engine
        from batchpid.sim.engine.native import status as native_status

        out = Outputs(force=self.force).path("out", self.out, (".json",))
        workers = len(os.sched_getaffinity(0)) if self.workers is None else self.workers
        load_engine(self.engine)
        workload = Workload(
            Robot.load(self.robot, **vars(self.meshes)),
            num_envs=integer("num_envs", self.num_envs, 1, 1_000_000),
            workers=integer("workers", workers, 0, 1024),
            physics=self.physics,
            engine=self.engine,
            substeps=integer("substeps", self.substeps, 1, 1_000_000),
            ticks=integer("ticks", self.ticks, 1, 1_000_000),
            rounds=integer("rounds", self.rounds, 1, 1000),
        )
        peers = installed_peers() if self.peers else ()
        names = cases_in(self.engine, self.xla, "mujoco" in peers)
        descriptions = names | {name: PEERS[name].description for name in peers}
        advance = iter(bar("bench")(range(workload.rounds * len(descriptions))))
        results = measure_rates(workload, progress=lambda case: next(advance, None), peers=peers, names=names)
        next(advance, None)  # close the bar
        phases = measure_phases(workload)
        free_phases = measure_phases(replace(workload, physics="free"), collisions=False)

        print(
            f"{workload.robot.name}, {workload.num_envs} envs, {workload.processes} processes, "
            f"physics {workload.physics!r}, {workload.substeps} substeps, {workload.rounds} rounds, "
            f"{native_status().describe(load_engine(self.engine).title)}\n"
        )
        ours = results[OURS]
        ratios = {case: ours.over(result) for case, result in results.items()}
        alike = {case: ratios[case] * result.processes / ours.processes for case, result in results.items()}
        rows = [
            [case, f"{result.rate / 1e3:,.1f}", f"{ratios[case]:.2f}", f"{alike[case]:.2f}", descriptions[case]]
            for case, result in results.items()
        ]
        print(table(rows, ["case", "thousand env-steps/s", f"{OURS} / case", "per process", "description"], "lrrrl"))
        print("\nmicroseconds per env step in a worker:")
        both = {OURS: phases, "no shapes, free": free_phases}
        figures = [[name, *(f"{value:.2f}" for value in spent.values())] for name, spent in both.items()]
        print(table(figures, ["", *phases], "l" + "r" * len(phases)))
        absent = sorted({peer.package for name, peer in PEERS.items() if self.peers and name not in peers})
        if absent:
            print(f"\nnot installed: {', '.join(absent)} (pip install 'batchpid[peers]')")
        if out is not None:
            cases = {
                case: {
                    "env_steps_per_second": result.rates,
                    "median": result.rate,
                    "closed_loop_over_case": ratios[case],
                    "closed_loop_over_case_per_process": alike[case],
                    "processes": result.processes,
                    "final_qpos": result.final.tolist(),
                }
                for case, result in results.items()
            }
            measured = {
                "setup": vars(workload) | {"robot": workload.robot.name},
                "machine": machine(),
                "cases": cases,
                "microseconds_per_env_step": phases,
                "microseconds_per_env_step_free": free_phases,
            }
            out.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(out, json.dumps(measured, indent=2) + "\n")
            print(f"\nwritten: {out}")


def machine() -> dict[str, Any]:
    """Return the hardware and the versions that figures depend on."""
    model = re.search(r"^model name\s*: (.*)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    return {
        "processor": model[1] if model else platform.processor() or platform.machine(),
        "cores": len(os.sched_getaffinity(0)),
        "system": platform.platform(),
        **package_versions(),
    }
