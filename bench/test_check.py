"""Performance checks: ratios of speeds that must not fall below their floors. ``make bench-check``
runs them.

A ratio compares two ways of stepping the same robots in one run, so it depends little on the
machine; a run is repeated before a check fails, because something else may have used the cores. To
compare absolute times with an earlier run of the same machine, use pytest-benchmark's
``--benchmark-save`` and ``--benchmark-compare-fail`` (docs/performance.md).
"""

from __future__ import annotations

import statistics
import time
from contextlib import ExitStack
from typing import NamedTuple

import numpy as np
import pytest
from measure import BY_TICKS, OURS, PYTHON, measure_rates
from tutorial import TutorialLoop
from workload import Workload

import batchpid as bp
from batchpid.sim import Robot
from batchpid.sim.engine import native

ATTEMPTS = 3
TICKS = 50
CASES = {
    "all off": {},
    "armature": {"armature": 1e-4},
    "strength": {"strength": 0.95},
    "effort limit": {"effort_limit": 60.0},
}
"""Options of actuators whose runners are compared with one of ideal ones."""


class Floor(NamedTuple):
    """Least ratio of the speeds of two cases, about a tenth below the ratio on an idle machine."""

    case: str
    over: str
    accurate: float
    fast: float
    reason: str


FLOORS = [
    Floor(
        OURS,
        "bare engine, robot by robot",
        0.76,
        0.68,
        "control and calls may take a quarter; of a fast step a third",
    ),
    Floor(OURS, "tutorial", 2.4, 3.4, "gain of a user of SAPIEN's tutorial, on 2 cores"),
    Floor(OURS, PYTHON, 1.0, 1.05, "purpose of the native extension"),
    Floor(OURS, BY_TICKS, 0.9, 0.9, "a rollout is not slower than its ticks one by one"),
    Floor(
        "closed loop, policy network",
        OURS,
        0.8,
        0.7,
        "a small network at every sim step costs less than the engine",
    ),
    Floor("closed loop, no shapes", OURS, 1.08, 1.25, "purpose of collisions=False"),
]
FEW_FLOORS = {
    # robots in the caller's process over the tutorial's own loop: (accurate, fast)
    1: (0.75, 0.95),  # one robot cannot share the cost of a NumPy call
    4: (0.95, 1.35),  # they share the calls
    16: (1.05, 1.7),  # a whole group of envs
}
ACTUATOR_FLOORS = {
    # a runner with these actuators over one with actuators=None
    "all off": 0.9,  # disabled effects cost nothing
    "armature": 0.9,  # the engine's
    "strength": 0.88,  # the velocity is read, and the effort processed
    "effort limit": 0.87,  # and limits given to the law
}


def speeds_over_ideal(physics, most, rounds):
    """Return the speed of each case relative to actuators=None: the median of rounds in which all
    take turns.

    Processor time of this process, in which the robots are: another program disturbs it less.
    """
    num_envs, rounds = min(16, most.envs), min(rounds, most.rounds)
    workload = Workload(Robot.load("panda"), num_envs, workers=0, physics=physics, ticks=10)
    setpoints = np.broadcast_to(workload.target, (workload.ticks, num_envs, len(workload.target)))
    rng, seconds = np.random.default_rng(0), []
    with ExitStack() as stack:
        chosen = {name: bp.make_actuators(9, **options) for name, options in CASES.items()}
        runners = {
            name: stack.enter_context(workload.runner(actuators=each))
            for name, each in {"ideal": None, **chosen}.items()
        }
        for _ in range(rounds + 1):
            took = {}
            for name in rng.permutation(list(runners)):
                runners[name].reset(workload.start)
                began = time.process_time()
                qpos = runners[name].rollout(setpoints).qpos[-1]
                took[name] = time.process_time() - began
                assert np.abs(qpos - workload.start)[:, workload.moving].max(1).min() > 0.02, (
                    "the robots did not move"
                )
            seconds.append(took)
    return {
        name: statistics.median(took["ideal"] / took[name] for took in seconds[1:])
        for name in CASES
    }


def few_robots(name, num_envs, physics, most, rounds=3):
    """Return the seconds per env step of our loop and of the tutorial's in each round (rounds,
    2).
    """
    num_envs, ticks, rounds = (
        min(num_envs, most.envs),
        min(TICKS, most.ticks),
        min(rounds, most.rounds),
    )
    workload = Workload(Robot.load(name), num_envs, workers=0, physics=physics, ticks=ticks)
    tutorial = TutorialLoop(workload.robot, workload.target, start=workload.start)
    setpoints = np.broadcast_to(workload.target, (ticks, *workload.target.shape))
    seconds = []
    with workload.runner() as runner:
        for _ in range(rounds + 1):
            tutorial.reset()
            runner.reset(workload.start)
            began = time.process_time()
            qpos = runner.rollout(setpoints).qpos[-1]
            between = time.process_time()
            final = tutorial.run(workload.steps)
            ended = time.process_time()
            seconds.append(
                (
                    (between - began) / (workload.steps * num_envs),
                    (ended - between) / workload.steps,
                )
            )
    for place in (*qpos, final):
        assert np.abs(place - workload.start)[workload.moving].max() > 0.05, (
            "the robots did not move"
        )
    return seconds[1:]


@pytest.fixture
def check(most):
    """Function that fails unless one of a few runs of ``measure`` has every ratio at its floor or
    above.
    """

    def check(label, measure):
        for _ in range(ATTEMPTS):
            found = measure()
            print(
                f"\n{label}: "
                + ", ".join(
                    f"{ratio:.3f} ({floor}) {name}" for name, (ratio, floor) in found.items()
                )
            )
            short = {
                name: both for name, both in found.items() if most.floors and both[0] < both[1]
            }
            if not short:
                return
        pytest.fail(f"{label}: (ratio, floor) in the last of {ATTEMPTS} runs: {short}")

    return check


@pytest.mark.check
@pytest.mark.parametrize("physics", ["accurate", "fast"])
@pytest.mark.parametrize("name", ["panda", "jaco2"])
def test_ratios_keep_their_floors(check, most, name, physics):
    floors = [floor for floor in FLOORS if not native.obstacle() or floor.over != PYTHON]
    names = dict.fromkeys(case for floor in floors for case in (floor.case, floor.over))

    def measure():
        envs, workers, rounds = min(48, most.envs), min(2, most.workers), min(3, most.rounds)
        workload = Workload(
            Robot.load(name), envs, workers, physics, ticks=60 if most.floors else 50, rounds=rounds
        )
        results = measure_rates(workload, names=names)
        return {
            f"{floor.case} / {floor.over}": (
                results[floor.case].over(results[floor.over]),
                getattr(floor, physics),
            )
            for floor in floors
        }

    check(f"{name}, {physics}", measure)


@pytest.mark.check
@pytest.mark.parametrize("physics", ["accurate", "fast"])
@pytest.mark.parametrize("name", ["panda", "jaco2"])
def test_few_robots_keep_their_floors(check, most, name, physics):
    def measure():
        found = {}
        for count in FEW_FLOORS:
            seconds = few_robots(name, count, physics, most, rounds=3)
            ratio = statistics.median(theirs / ours for ours, theirs in seconds)
            found[f"{count} in this process / tutorial"] = (
                ratio,
                FEW_FLOORS[count][physics == "fast"],
            )
        return found

    check(f"{name}, {physics}", measure)


@pytest.mark.check
@pytest.mark.parametrize("physics", ["accurate", "fast"])
def test_actuators_keep_their_floors(check, most, physics):
    def measure():
        speeds = speeds_over_ideal(physics, most, rounds=30)
        return {f"{name} / ideal": (ratio, ACTUATOR_FLOORS[name]) for name, ratio in speeds.items()}

    check(f"actuators of panda, {physics}", measure)
