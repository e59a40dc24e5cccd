"""Speed of the runner and of its baselines in one run, for ``batchpid bench`` and ``bench/``.

Every case moves the same robots from ``start`` to ``target`` with the tutorial's gains and, in SAPIEN, with SAPIEN's
friction and damping. So the cases differ in the way of stepping and not in the motion. Baselines run in separate worker
processes, as many as the runner has.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Collection
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Float64
from batchpid.sim.benchmark.baselines import ENGINES, make_baselines
from batchpid.sim.benchmark.peers import make_peers
from batchpid.sim.benchmark.policy import ResidualPolicy
from batchpid.sim.benchmark.workload import Case, Workload, run_round
from batchpid.sim.engine.native import python_calls
from batchpid.sim.engine.protocol import EnginePack
from batchpid.sim.loop.arrays import Arrays, Command
from batchpid.sim.loop.loop import Loop
from batchpid.sim.options import RunnerOptions
from batchpid.sim.runner import Runner
from batchpid.sim.workers.shared_memory import SharedArrays

CASES = {
    "tutorial": "the tutorial's loop as written: one robot, one process",
    "tutorial, a process a core": "the tutorial's loop, one robot in each of the processes",
    "bare engine": "internal drive, no control, no gravity, all robots stepped in turn",
    "bare engine, robot by robot": "the same, each robot stepped for a tick while it is in the cache",
    "bare engine, no shapes": "the same without collision shapes",
    "closed loop, Python calls": "the closed loop without the native extension",
    "closed loop, tick by tick": "PID, gravity and Coriolis compensation at every sim step: Runner.step, tick by tick",
    "closed loop": "the same by Runner.rollout: the workers never wait for each other",
    "closed loop, policy network": "the same with a network of 64 x 64 units in the law, in NumPy: a Controller",
    "closed loop, no shapes": "the closed loop for free motion: Runner(collisions=False)",
    "closed loop, no shapes, free": "the same with physics 'free'",
}
XLA_CASES = {
    "closed loop, XLA": "law and sim steps of a tick in one program of XLA: Runner(backend='jax')",
    "closed loop, policy network, XLA": "the same with a network of 64 x 64 units in the law",
    "closed loop, no shapes, free, XLA": "the closed loop in XLA without collision shapes, with physics 'free'",
}
"""Cases of the Runner that first compile for some seconds."""
IN_MUJOCO = {"closed loop, MuJoCo": "the closed loop in the other engine: Runner(engine='mujoco')"}
"""Case of the Runner in MuJoCo, in a benchmark of SAPIEN."""
MUJOCO = {
    "bare engine": "mujoco.batch: its position actuators, no control, no gravity, all robots stepped in one call",
}
"""Baselines of a benchmark of MuJoCo, besides the tutorial's loop in SAPIEN."""
OURS, BY_TICKS, PYTHON = "closed loop", "closed loop, tick by tick", "closed loop, Python calls"
PHASES = {
    # phase of a sim step: methods of the pack that it calls
    "read": ("read_qpos", "read_qvel"),
    "passive": ("passive_force",),
    "write": ("write_qf",),
    "step": ("step",),
}


@dataclass(frozen=True)
class Result:
    """Figures of one case: env-steps per second of every round, final positions of the first env (dof,), and number of
    stepping processes.
    """

    rates: tuple[float, ...]
    final: Float64
    processes: int

    @property
    def rate(self) -> float:
        """Median env-steps per second."""
        return statistics.median(self.rates)

    def over(self, other: Result) -> float:
        """Return this rate divided by the other's: the median of the ratios within each round."""
        return statistics.median(ours / theirs for ours, theirs in zip(self.rates, other.rates, strict=True))


def cases_in(engine: str = "sapien", xla: bool = False, mujoco: bool = False) -> dict[str, str]:
    """Return the descriptions of the cases in ``engine``, by name; ``xla`` and ``mujoco`` add those cases."""
    named = CASES | (XLA_CASES if xla else {})
    if engine == "sapien":
        return named | (IN_MUJOCO if mujoco else {})
    sapiens = {name for name in ENGINES if name not in MUJOCO}
    return {name: MUJOCO.get(name, text) for name, text in named.items() if name not in sapiens}


def make_closed_loops(workload: Workload, names: Collection[str] = tuple(CASES)) -> dict[str, Case]:
    """Return the cases of the Runner among ``names``. The case tick by tick uses the runner of the rollouts."""
    target, ticks, shared = workload.target, workload.ticks, dict[str, Runner]()

    def runner(name: str) -> Runner:
        if name == PYTHON:
            with python_calls():
                return workload.runner()
        engine = "mujoco" if name in IN_MUJOCO else workload.engine
        return replace(workload, engine=engine).runner(**_options(workload)[name])

    def rollout(runner: Runner) -> NDArray[np.float32]:
        return runner.rollout(np.broadcast_to(target, (ticks, *target.shape))).qpos[-1, 0]

    def tick_by_tick(runner: Runner) -> NDArray[np.float32]:
        for _ in range(ticks):
            final = runner.step(target).qpos[0]
        return final

    def case(name: str, run: Callable[[Runner], NDArray[Any]]) -> Case:
        kind = OURS if name == BY_TICKS else name
        if kind not in shared:
            shared[kind] = runner(kind)
        ours = shared[kind]
        env_steps = workload.num_envs * workload.steps
        return Case(env_steps, lambda: ours.reset(workload.start), lambda: run(ours), ours.close, workload.processes)

    kinds = [PYTHON, BY_TICKS, *_options(workload)]
    return {name: case(name, tick_by_tick if name == BY_TICKS else rollout) for name in kinds if name in names}


def _options(workload: Workload) -> dict[str, dict[str, Any]]:
    """Return the options of the runner in each case of a rollout."""
    free = {"collisions": False, "physics": "free"}
    return {
        OURS: {},
        "closed loop, policy network": {"control": ResidualPolicy(workload.robot)},
        "closed loop, no shapes": {"collisions": False},
        "closed loop, no shapes, free": free,
        "closed loop, XLA": {"backend": "jax"},
        "closed loop, policy network, XLA": {"control": ResidualPolicy(workload.robot), "backend": "jax"},
        "closed loop, no shapes, free, XLA": free | {"backend": "jax"},
        "closed loop, MuJoCo": {},
    }


def measure_rates(
    workload: Workload,
    progress: Callable[[str], None] = lambda case: None,
    peers: Collection[str] = (),
    names: Collection[str] = tuple(CASES),
) -> dict[str, Result]:
    """Measure the cases ``names`` and ``peers`` ``workload.rounds`` times in turn, so that their rounds are paired.

    ``names`` are among CASES, XLA_CASES and IN_MUJOCO. ``progress`` is called with the case's name before every round.
    Raises BatchPIDError if the robots of a case did not move or ended far from the target, and MissingDependencyError
    if the package of a peer is not installed.
    """
    with ExitStack() as stack:
        cases = make_peers(workload, peers) | make_baselines(workload) | make_closed_loops(workload, names)
        for case in cases.values():
            stack.callback(case.close)
        order = [*(name for name in CASES | XLA_CASES | IN_MUJOCO if name in names), *peers]
        seconds: dict[str, list[float]] = {name: [] for name in order}
        final = {}
        for name in XLA_CASES.keys() & cases.keys():
            run_round(cases[name])  # compiles
        for _ in range(workload.rounds):
            for name, rounds in seconds.items():
                progress(name)
                took, final[name] = run_round(cases[name])
                rounds.append(took)
    for name, place in final.items():
        workload.check_motion(name, place)
    return {
        name: Result(tuple(cases[name].env_steps / took for took in rounds), final[name], cases[name].processes)
        for name, rounds in seconds.items()
    }


def measure_phases(workload: Workload, collisions: bool = True) -> dict[str, float]:
    """Return the microseconds per env step that each phase of the closed loop takes in a worker.

    Measured in this process with a worker's share of the envs. The control step runs in NumPy, with native calls into
    the engine if available, because the phases of a native tick cannot be separated. "control" is everything except
    calls into the engine; it takes a fraction of that time in a native tick. The clock calls add about one percent.
    "waiting" is the mean time of a tick of :meth:`Runner.step` beyond the work of a worker.
    """
    share = max(1, workload.num_envs // workload.processes)
    robot = workload.simulated_robot
    shared = SharedArrays(Arrays.layout(1, share, robot.dof))
    options = RunnerOptions(
        robot, share, physics=workload.physics, collisions=collisions, engine=workload.engine
    )  # fmt: skip
    loop = Loop(options, robot.params(), slice(0, share), Arrays.from_fields(shared.arrays))
    loop.reset(np.ones(share, bool), np.tile(workload.start, (share, 1)), np.zeros((share, workload.robot.dof)))
    loop.ticks[0].command.setpoint[...] = workload.target
    spent = dict.fromkeys(("read", "control", "passive", "write", "step", "waiting"), 0.0)
    for group in loop.groups:
        group.execute_in_numpy()
        _time_calls(group.pack, spent)
    given = Command(workload.target).given
    total = sum(loop.run(1, workload.substeps, given) for _ in range(workload.ticks))
    loop.close()
    shared.close()
    env_steps = workload.steps * share
    spent["control"] = total - sum(spent.values())
    spent["waiting"] = _waiting(workload, collisions) * env_steps
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


def _waiting(workload: Workload, collisions: bool) -> float:
    """Return the mean seconds per env step of a tick beyond the work of a worker."""
    with workload.runner(collisions=collisions) as runner:
        runner.step(workload.target)
        idle = 0.0
        for _ in range(workload.ticks):
            began = time.perf_counter()
            runner.step(workload.target)
            idle += time.perf_counter() - began - float(np.mean(runner.work_seconds))
    return idle / (workload.steps * workload.num_envs / workload.processes)
