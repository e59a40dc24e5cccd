"""What the runner is measured against, side by side in one run: ``batchpid bench`` and ``bench/`` are made of this.

Every case moves the same robots from ``start`` to ``target`` with the tutorial's gains and with SAPIEN's own friction
and damping, so that what is compared is the way of stepping and not the motion. The cases that step scenes by process
run in worker processes of their own, one for each worker, each with its share of the envs.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.errors import BatchPIDError, InvalidArgumentError
from sim.benchmark.baselines import BaselineProcess, run_baseline
from sim.benchmark.peers import Stepper, make_peer, run_peer
from sim.benchmark.setup import DISTANCE, Setup
from sim.loop.arrays import Arrays
from sim.loop.loop import Loop, LoopSpec
from sim.robot.robot import Robot
from sim.runner import Runner

Float64 = NDArray[np.float64]
CASES = {
    "tutorial": "the tutorial's loop as written: one robot, one process",
    "tutorial, a process a core": "the tutorial's loop, one robot in each of the processes",
    "drive, a scene a robot": "internal drive, no control, one PhysX system to a robot, all stepped in turn",
    "bare engine, packs of 8": "internal drive, no control, no gravity, 8 robots to a system, all stepped in turn",
    "bare engine": "the same, 4 robots to a system, as the Runner packs them",
    "bare engine, pack by pack": "the same, each pack stepped for a tick while it is in the cache",
    "closed loop, tick by tick": "PID, gravity and Coriolis compensation at every sim step: Runner.step, tick by tick",
    "closed loop": "the same by Runner.rollout: as all of the above, the workers never wait for each other",
}
PHASES = {
    "read": ("read_qpos", "read_qvel"),
    "passive": ("passive_force",),
    "write": ("write_qf",),
    "step": ("step",),
}


@dataclass(frozen=True)
class Result:
    """Figures of one case: env-steps per second of every round, and where the first env ended (dof,)."""

    rates: tuple[float, ...]
    final: Float64

    @property
    def rate(self) -> float:
        """Median env-steps per second."""
        return statistics.median(self.rates)


def compare(
    setup: Setup, progress: Callable[[str], None] = lambda case: None, peers: Sequence[str] = ()
) -> dict[str, Result]:
    """Measure every case ``setup.rounds`` times in turn; the rounds of different cases are paired.

    ``peers`` are cases of :data:`sim.benchmark.peers.PEERS` to measure as well.

    Raises
    ------
    InvalidArgumentError
        The robot carries no gains and target to move with.
    BatchPIDError
        The robots of a case did not move, or ended elsewhere: its figure would mean nothing.
    MissingDependencyError
        The package of a peer is not installed.
    """
    robot, cases = setup.robot, (*CASES, *peers)
    if robot.settings is None:
        raise InvalidArgumentError(
            "robot", f"{robot.name!r} carries no gains and target", remedy=f"use one of {Robot.bundled()}"
        )
    rates: dict[str, list[float]] = {case: [] for case in cases}
    final: dict[str, Float64] = {}
    robot = Robot.load(robot.path, dissipation="sapien")
    processes: list[BaselineProcess] = []
    others: dict[str, Stepper] = {}
    try:
        processes += [BaselineProcess(setup, index) for index in range(max(setup.workers, 1))]
        others |= {name: make_peer(name, setup) for name in peers}
        with Runner(
            robot, setup.num_envs, workers=setup.workers, physics=setup.physics, substeps=setup.substeps
        ) as runner:
            for _ in range(setup.rounds):
                for case in cases:
                    progress(case)
                    if case in others:
                        seconds, steps, final[case] = run_peer(others[case], setup)
                    elif case.startswith("closed loop"):
                        seconds, steps, final[case] = run_closed_loop(case, runner, setup)
                    else:
                        taken = processes[:1] if case == "tutorial" else processes
                        seconds, steps, final[case] = run_baseline(case, taken, setup)
                    rates[case].append(steps / seconds)
    finally:
        for process in processes:
            process.close()
        for other in others.values():
            other.close()
    for case, place in final.items():
        check_motion(case, place, setup)
    return {case: Result(tuple(rates[case]), final[case]) for case in cases}


def phases(setup: Setup) -> dict[str, float]:
    """Microseconds per env step that each phase of the closed loop takes, in one process with a worker's share.

    "control" is all that is not a call on the engine. The clock's own calls are in the figures: they add about one
    percent. "waiting" is what a tick of :meth:`Runner.step` takes beyond the work of a worker, on average.
    """
    share = max(1, setup.num_envs // max(setup.workers, 1))
    spec = LoopSpec(setup.scene(gravity=True), share, Robot.load(setup.robot.path, dissipation="sapien").params())
    layout = Arrays.layout(1, share, setup.robot.dof).items()
    fields = {name: np.zeros(shape, dtype) for name, (shape, dtype) in layout}
    loop = Loop(spec, Arrays.of_ticks(fields, slice(0, share)))
    clocks = [_Clock(group) for group in loop.groups]
    everyone, still = np.ones(share, bool), np.zeros((share, setup.robot.dof))
    loop.reset(everyone, np.tile(setup.start, (share, 1)), still)
    loop.ticks[0].command.setpoint[...] = setup.target
    for clock in clocks:
        clock.seconds.clear()
    total = sum(loop.run(1, setup.substeps, False, False) for _ in range(setup.ticks))
    loop.close()
    steps = setup.ticks * setup.substeps * share
    spent = {
        phase: sum(clock.seconds.get(call, 0.0) for clock in clocks for call in calls)
        for phase, calls in PHASES.items()
    }
    spent["control"] = total - sum(spent.values())
    spent["waiting"] = _waiting(setup) * steps
    order = ("read", "control", "passive", "write", "step", "waiting")
    return {phase: spent[phase] / steps * 1e6 for phase in order}


def _waiting(setup: Setup) -> float:
    """Seconds per env step of a worker between the end of its work and the next tick, on average."""
    with Runner(
        setup.robot, setup.num_envs, workers=setup.workers, physics=setup.physics, substeps=setup.substeps
    ) as runner:
        runner.step(setup.target)
        idle = 0.0
        for _ in range(setup.ticks):
            began = time.perf_counter()
            runner.step(setup.target)
            idle += time.perf_counter() - began - float(np.mean(runner.work_seconds))
    return idle / (setup.ticks * setup.substeps * setup.num_envs / max(setup.workers, 1))


def run_closed_loop(case: str, runner: Runner, setup: Setup) -> tuple[float, int, Float64]:
    """Run one round of ``case`` on ``runner``: (seconds, env-steps, where the first env ended)."""
    runner.reset(setup.start)
    began = time.perf_counter()
    if case == "closed loop":
        final = runner.rollout(np.broadcast_to(setup.target, (setup.ticks, setup.robot.dof))).qpos[-1]
    else:
        for _ in range(setup.ticks):
            final = runner.step(setup.target).qpos
    seconds = time.perf_counter() - began
    return seconds, setup.num_envs * setup.ticks * setup.substeps, final[0].astype(np.float64)


def check_motion(case: str, place: Float64, setup: Setup) -> None:
    """Raise unless the robot at ``place`` (dof,) has moved from the start towards the target."""
    moving = setup.moving
    way = np.abs(place - setup.start)[moving]
    left = np.abs(place - setup.target)[moving]
    if not np.isfinite(place).all() or way.min() < 0.1 * DISTANCE or left.max() > DISTANCE:
        raise BatchPIDError(
            f"case {case!r}: the robots did not move as they should (moved {way.round(3)}, left {left.round(3)}); "
            "its speed would mean nothing: run more ticks"
        )


class _Clock:
    """Adds up the seconds of every call on a group's pack, by the call's name."""

    def __init__(self, group: Any) -> None:
        self.seconds: dict[str, float] = {}
        self._pack = group.pack
        group.pack = self

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._pack, name)
        if name not in {call for calls in PHASES.values() for call in calls}:
            return value
        clock, seconds = time.perf_counter, self.seconds

        def timed(*args: Any) -> Any:
            began = clock()
            result = value(*args)
            seconds[name] = seconds.get(name, 0.0) + clock() - began
            return result

        self.__dict__[name] = timed
        return timed
