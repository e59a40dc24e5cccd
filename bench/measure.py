"""Speed of the runner and of its baselines in one run.

    python bench/measure.py panda --physics fast [--peers] [--json FILE]

Every case moves the same robots from ``start`` to ``target`` with the tutorial's gains and, in
SAPIEN, with SAPIEN's friction and damping. So the cases differ in the way of stepping and not in
the motion. Baselines run in separate worker processes, as many as the runner has.
docs/performance.md describes the cases.
"""

from __future__ import annotations

import json
import os
import platform
import re
import statistics
import time
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal
from unittest.mock import patch

import numpy as np
import tyro
from baselines import ENGINES, TUTORIALS, make_baselines
from peers import PEERS, installed_peers
from policy import ResidualPolicy
from workload import Case, Workload, run_round

from batchpid.io.files import package_versions, write_atomically
from batchpid.sim import Robot
from batchpid.sim.diagnosis.causes import table
from batchpid.sim.engine import native
from batchpid.sim.engine.protocol import EnginePack, load_engine
from batchpid.sim.loop import native_executor
from batchpid.sim.loop.arrays import Arrays
from batchpid.sim.loop.loop import Loop
from batchpid.sim.options.options import RunnerOptions
from batchpid.sim.randomization.distributions import NOTHING
from batchpid.sim.workers.requests import SharedArrays
from batchpid.stages.values import Command

OURS, BY_TICKS, PYTHON = "closed loop", "closed loop, tick by tick", "closed loop, Python calls"
POLICY, NO_SHAPES = "closed loop, policy network", "closed loop, no shapes"
LOOPS = {
    # case of the Runner: its options
    PYTHON: {},
    BY_TICKS: {},
    OURS: {},
    POLICY: {},
    NO_SHAPES: {"collisions": False},
}
MUJOCO_LOOPS = {"closed loop, MuJoCo": {"engine": "mujoco"}}
CASES = (*TUTORIALS, *ENGINES, *LOOPS)
"""Cases without MuJoCo and peers."""
PHASES = {
    # phase of a sim step: methods of the pack that it calls
    "read": ("read_qpos", "read_qvel"),
    "passive": ("passive_force",),
    "write": ("write_qf",),
    "step": ("step",),
}


@dataclass(frozen=True)
class Result:
    """Figures of one case: env-steps per second of every round, final positions of the first env
    (dof,), and number of stepping processes.
    """

    rates: tuple[float, ...]
    final: np.ndarray
    processes: int

    @property
    def rate(self) -> float:
        """Median env-steps per second."""
        return statistics.median(self.rates)

    def over(self, other: Result) -> float:
        """Return this rate divided by the other's: the median of the ratios within each round."""
        return statistics.median(
            ours / theirs for ours, theirs in zip(self.rates, other.rates, strict=True)
        )


def make_loop(workload: Workload, name: str) -> Case:
    """Return a case of the Runner."""
    options = dict((LOOPS | MUJOCO_LOOPS)[name])
    if name.startswith(POLICY):
        options["control"] = ResidualPolicy(workload.robot)
    with patch.dict(os.environ, {native.SWITCH: "0"} if name == PYTHON else {}):
        runner = workload.runner(**options)
    setpoints = np.broadcast_to(workload.target, (workload.ticks, *workload.target.shape))

    def run() -> np.ndarray:
        if name != BY_TICKS:
            return runner.rollout(setpoints).qpos[-1, 0]
        for setpoint in setpoints:
            final = runner.step(setpoint).qpos[0]
        return final

    env_steps = workload.num_envs * workload.steps
    return Case(
        env_steps, lambda: runner.reset(workload.start), run, runner.close, workload.processes
    )


def measure_rates(workload: Workload, names: Iterable[str] = CASES) -> dict[str, Result]:
    """Measure the cases ``names`` ``workload.rounds`` times in turn, so that their rounds are
    paired.

    Raises RuntimeError if the robots of a case did not move or ended far from the target.
    """
    seconds: dict[str, list[float]] = {name: [] for name in names}
    final = {}
    with ExitStack() as stack:
        cases = {name: make(workload) for name, (_, make) in PEERS.items() if name in seconds}
        cases |= make_baselines(workload)
        cases |= {
            name: make_loop(workload, name) for name in LOOPS | MUJOCO_LOOPS if name in seconds
        }
        for case in cases.values():
            stack.callback(case.close)
        for _ in range(workload.rounds):
            for name, rounds in seconds.items():
                took, final[name] = run_round(cases[name])
                rounds.append(took)
    for name, place in final.items():
        workload.check_motion(name, place)
    return {
        name: Result(
            tuple(cases[name].env_steps / took for took in rounds),
            final[name],
            cases[name].processes,
        )
        for name, rounds in seconds.items()
    }


def measure_phases(workload: Workload) -> dict[str, float]:
    """Return the microseconds per env step that each phase of the closed loop takes in a worker.

    Measured in this process with a worker's share of the envs. The control step runs in NumPy, with
    native calls into the engine if available, because the phases of a native tick cannot be
    separated. "control" is everything except calls into the engine; it takes a fraction of that
    time in a native tick. The clock calls add about one percent.
    """
    share = max(1, workload.num_envs // workload.processes)
    robot = workload.simulated_robot()
    params = robot.params()
    options = RunnerOptions(robot, share, engine="sapien", physics=workload.physics, params=params)
    shared = SharedArrays(Arrays.layout(options, 1, share))
    # In NumPy, with a call for each phase.
    with patch.object(native_executor, "runs_natively", return_value=False):
        loop = Loop(options, slice(0, share), shared.arrays)
    for group in loop.groups:
        group._executor._is_native = False
    places = np.tile(workload.start, (share, 1)), np.zeros((share, robot.dof))
    loop.execute("reset", (np.ones(share, bool), *places, NOTHING, None))
    loop.arrays.command.setpoint[...] = workload.target
    spent = dict.fromkeys(("read", "control", "passive", "write", "step"), 0.0)
    for group in loop.groups:
        _time_calls(group.pack, spent)
    given = Command(workload.target).given
    began = time.perf_counter()
    for _ in range(workload.ticks):
        loop.execute("run", (1, workload.substeps, given))
    total = time.perf_counter() - began
    loop.close()
    shared.close()
    env_steps = workload.steps * share
    spent["control"] = total - sum(spent.values())
    return {phase: seconds / env_steps * 1e6 for phase, seconds in spent.items()}


def _time_calls(pack: EnginePack, spent: dict[str, float]) -> None:
    """Replace the methods of each phase of ``pack`` by ones that add their seconds to ``spent``."""

    def timed(phase: str, call: Callable[..., Any]) -> Callable[..., Any]:
        def run(*args: Any) -> Any:
            began = time.perf_counter()
            result = call(*args)
            spent[phase] += time.perf_counter() - began
            return result

        return run

    for phase, names in PHASES.items():
        for name in names:
            setattr(pack, name, timed(phase, getattr(pack, name)))


@dataclass(frozen=True)
class Options:
    """Measure the speed of the closed loop and its phases, of the tutorial's loop and of the bare
    engine.

    Rates are medians over the rounds. Ratios are medians of the rounds' ratios, of all processes
    together and per process.
    """

    robot: tyro.conf.Positional[Literal["panda", "jaco2"]] = "panda"
    num_envs: int = 64
    workers: int | None = None
    """Default: one for each available core."""
    physics: Literal["accurate", "fast"] = "accurate"
    ticks: int = 100
    rounds: int = 5
    peers: bool = False
    """Measure MuJoCo, with the closed loop and alone, and Gymnasium's AsyncVectorEnv, too, where
    installed.
    """
    json: Path | None = None
    """File for the figures, for draw.py."""


def main(options: Options) -> None:
    """Print the tables and write the figures."""
    cores = len(os.sched_getaffinity(0))
    workload = Workload(
        Robot.load(options.robot),
        options.num_envs,
        workers=cores if options.workers is None else options.workers,
        physics=options.physics,
        ticks=options.ticks,
        rounds=options.rounds,
    )
    peers = installed_peers() if options.peers else []
    names = [
        *CASES,
        *(MUJOCO_LOOPS if "mujoco" in peers else ()),
        *peers,
    ]
    results = measure_rates(workload, names)
    ratios = {case: results[OURS].over(result) for case, result in results.items()}
    figures = {
        "rates": {case: round(result.rate) for case, result in results.items()},
        "ratios": {case: round(ratio, 3) for case, ratio in ratios.items()},
        "per_process": {
            case: round(ratios[case] * result.processes / workload.processes, 3)
            for case, result in results.items()
        },
        "phases": {phase: round(us, 2) for phase, us in measure_phases(workload).items()},
    }
    calls = load_engine("sapien").native_obstacle() or "native calls"
    print(f"{options.robot}, {options.num_envs} envs, {workload.processes} processes, {calls}\n")
    columns = figures["rates"], figures["ratios"], figures["per_process"]
    rows = [
        [case, f"{rate / 1e3:,.1f}", *(f"{each[case]:.2f}" for each in columns[1:])]
        for case, rate in columns[0].items()
    ]
    print(table(rows, ["case", "thousand env-steps/s", f"{OURS} / case", "per process"], "lrrr"))
    print("\nmicroseconds per env step in a worker:")
    print(
        table([[OURS, *map(str, figures["phases"].values())]], ["", *figures["phases"]], "lrrrrr")
    )
    if options.json is not None:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(options.json, json.dumps({"machine": machine()} | figures) + "\n")


def machine() -> dict[str, Any]:
    """Return the hardware and the versions that figures depend on."""
    model = re.search(r"^model name\s*: (.*)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    return {
        "processor": model[1] if model else platform.processor() or platform.machine(),
        "cores": len(os.sched_getaffinity(0)),
        "system": platform.platform(),
        **package_versions(),
    }


if __name__ == "__main__":
    main(tyro.cli(Options))
