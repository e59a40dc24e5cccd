"""Speed of the runner and of its baselines in one run: ``batchpid bench`` and ``bench/`` are made of this.

Every case moves the same robots from ``start`` to ``target`` with the tutorial's gains and with SAPIEN's own friction
and damping, so that the cases differ in the way of stepping and not in the motion. Baselines run in worker processes of
their own, as many as the runner has.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Collection
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.benchmark.baselines import make_baselines
from sim.benchmark.peers import make_peers
from sim.benchmark.workload import Case, Workload, run_round
from sim.engine.native import python_calls
from sim.engine.pack import Pack
from sim.loop.arrays import Arrays
from sim.loop.loop import Loop
from sim.options import RunnerOptions
from sim.robot.robot import Robot
from sim.runner import Runner
from sim.workers.shared_memory import SharedArrays

Float64 = NDArray[np.float64]
CASES = {
    "tutorial": "the tutorial's loop as written: one robot, one process",
    "tutorial, a process a core": "the tutorial's loop, one robot in each of the processes",
    "drive, a scene a robot": "internal drive, no control, one PhysX system to a robot, all stepped in turn",
    "bare engine, packs of 8": "internal drive, no control, no gravity, 8 robots to a system, all stepped in turn",
    "bare engine": "the same, 4 robots to a system, as the Runner packs them",
    "bare engine, pack by pack": "the same, each pack stepped for a tick while it is in the cache",
    "closed loop, Python calls": "the closed loop without the native extension: the same as below, if there is none",
    "closed loop, tick by tick": "PID, gravity and Coriolis compensation at every sim step: Runner.step, tick by tick",
    "closed loop": "the same by Runner.rollout: as all of the above, the workers never wait for each other",
}
PHASES = {
    # phase of a sim step: the calls on the pack that it consists of
    "read": ("read_qpos", "read_qvel"),
    "passive": ("passive_force",),
    "write": ("write_qf",),
    "step": ("step",),
}


@dataclass(frozen=True)
class Result:
    """Figures of one case: env-steps per second of every round, and the final positions of the first env (dof,)."""

    rates: tuple[float, ...]
    final: Float64

    @property
    def rate(self) -> float:
        """Median env-steps per second."""
        return statistics.median(self.rates)


def make_closed_loops(workload: Workload) -> dict[str, Case]:
    """Return the cases of the Runner, by name; all but that of Python's calls share one runner."""
    runner, target, ticks = workload.runner(), workload.target, workload.ticks
    with python_calls():
        python = workload.runner()

    def tick_by_tick() -> NDArray[np.float32]:
        for _ in range(ticks):
            final = runner.step(target).qpos[0]
        return final

    def rollout(runner: Runner) -> NDArray[np.float32]:
        return runner.rollout(np.broadcast_to(target, (ticks, *target.shape))).qpos[-1, 0]

    def case(runner: Runner, run: Callable[[], NDArray[Any]]) -> Case:
        return Case(workload.num_envs * workload.steps, lambda: runner.reset(workload.start), run, runner.close)

    return {
        "closed loop, Python calls": case(python, lambda: rollout(python)),
        "closed loop, tick by tick": case(runner, tick_by_tick),
        "closed loop": case(runner, lambda: rollout(runner)),
    }


def measure_rates(
    workload: Workload, progress: Callable[[str], None] = lambda case: None, peers: Collection[str] = ()
) -> dict[str, Result]:
    """Measure every case and ``peers`` ``workload.rounds`` times in turn; the rounds of different cases are paired.

    ``progress`` is called with the case's name before every round. Raises BatchPIDError where the robots of a case did
    not move or ended elsewhere, and MissingDependencyError where the package of a peer is not installed.
    """
    with ExitStack() as stack:
        cases = make_peers(workload, peers) | make_baselines(workload) | make_closed_loops(workload)
        for case in cases.values():
            stack.callback(case.close)
        seconds: dict[str, list[float]] = {name: [] for name in (*CASES, *peers)}
        final = {}
        for _ in range(workload.rounds):
            for name, rounds in seconds.items():
                progress(name)
                took, final[name] = run_round(cases[name])
                rounds.append(took)
    for name, place in final.items():
        workload.check_motion(name, place)
    return {
        name: Result(tuple(cases[name].env_steps / took for took in rounds), final[name])
        for name, rounds in seconds.items()
    }


def measure_phases(workload: Workload) -> dict[str, float]:
    """Return the microseconds per env step that each phase of the closed loop takes in a worker.

    Measured in this process with a worker's share of the envs. "control" is everything but calls on the engine. The
    time of the clock calls is included: about one percent. "waiting" is the mean time of a tick of
    :meth:`Runner.step` beyond the work of a worker.
    """
    share = max(1, workload.num_envs // workload.processes)
    robot = Robot.load(workload.robot.path, dissipation="sapien")
    shared = SharedArrays(Arrays.layout(1, share, robot.dof))
    options = RunnerOptions(robot, share, physics=workload.physics)
    loop = Loop(options, robot.params(), slice(0, share), Arrays.from_fields(shared.arrays))
    loop.reset(np.ones(share, bool), np.tile(workload.start, (share, 1)), np.zeros((share, workload.robot.dof)))
    loop.ticks[0].command.setpoint[...] = workload.target
    spent = dict.fromkeys(("read", "control", "passive", "write", "step", "waiting"), 0.0)
    for group in loop.groups:
        _time_calls(group.pack, spent)
    total = sum(loop.run(1, workload.substeps, False, False) for _ in range(workload.ticks))
    loop.close()
    shared.close()
    env_steps = workload.steps * share
    spent["control"] = total - sum(spent.values())
    spent["waiting"] = _waiting(workload) * env_steps
    return {phase: seconds / env_steps * 1e6 for phase, seconds in spent.items()}


def _time_calls(pack: Pack, spent: dict[str, float]) -> None:
    """Replace the calls of each phase on ``pack`` by ones that add their seconds to ``spent``."""

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


def _waiting(workload: Workload) -> float:
    """Return the mean seconds per env step between the end of a worker's work and the next tick."""
    with workload.runner() as runner:
        runner.step(workload.target)
        idle = 0.0
        for _ in range(workload.ticks):
            began = time.perf_counter()
            runner.step(workload.target)
            idle += time.perf_counter() - began - float(np.mean(runner.work_seconds))
    return idle / (workload.steps * workload.num_envs / workload.processes)
