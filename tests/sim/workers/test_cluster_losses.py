"""Machines and processes of a cluster, killed or stopped at random moments of many rollouts."""

from __future__ import annotations

import os
import random
import signal
import threading
import warnings

import numpy as np
import pytest
from clusters import FILTERS, ROBOT, Machines, make_runner, pids_of, setpoints
from identical import assert_identical
from processes import have_ended

from batchpid.sim import RecoveryWarning
from batchpid.sim.tuning import Moves, tune

ray = pytest.importorskip("ray")
pytestmark = [*FILTERS, pytest.mark.slow]

TICKS = 700
MACHINE_KILLS, PROCESS_KILLS, SEEDS = (
    int(os.environ.get(f"BATCHPID_SOAK_{name}", count))
    for name, count in (("MACHINE_KILLS", 5), ("PROCESS_KILLS", 4), ("SEEDS", 3))
)


@pytest.fixture(scope="module")
def machines():
    made = Machines()
    yield made
    made.close()


@pytest.fixture(scope="module")
def undisturbed():
    with make_runner(workers=0, checkpoint_steps=4000) as runner:
        return runner.rollout(setpoints(TICKS))


def disturbed_rollout(machines, disturb, tick):
    """Return a rollout on two machines, before this ``tick`` of which ``disturb`` is called; and the losses."""

    def progress(ticks):
        for number in ticks:
            if number == tick:
                disturb(runner.nodes)
            yield number

    with make_runner(cluster=machines.ensure(2).options(2), checkpoint_steps=4000) as runner:
        pids = pids_of(runner)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RecoveryWarning)
            rollout = runner.rollout(setpoints(TICKS), progress=progress)
        pids += pids_of(runner)
        recoveries = runner.recoveries
    assert have_ended(pids)
    return rollout, recoveries


def test_kills_of_machines(machines, undisturbed):
    chance, recovered = random.Random(1), 0
    for _ in range(MACHINE_KILLS):
        kill = lambda nodes: machines.kill(chance.choice(nodes).pid)  # noqa: E731
        rollout, recoveries = disturbed_rollout(machines, kill, chance.randrange(TICKS // 2))
        assert_identical(undisturbed, rollout)
        recovered += recoveries
    assert recovered >= MACHINE_KILLS // 2  # the others ended before their machine's end was noticed


def test_kills_of_processes(machines, undisturbed):
    chance, recovered = random.Random(2), 0
    for _ in range(PROCESS_KILLS):
        kill = lambda nodes: os.kill(chance.choice(nodes).pid, signal.SIGKILL)  # noqa: E731
        rollout, recoveries = disturbed_rollout(machines, kill, chance.randrange(TICKS // 2))
        assert_identical(undisturbed, rollout)
        recovered += recoveries
    assert recovered == PROCESS_KILLS


def test_a_machine_that_is_stopped_for_a_while(machines, undisturbed):
    def stop(nodes):
        _, raylet = machines.raylet(nodes[1].pid)
        os.kill(raylet.pid, signal.SIGSTOP)
        continued = threading.Timer(20.0, lambda: os.kill(raylet.pid, signal.SIGCONT))
        continued.start()
        timers.append(continued)

    timers = []
    rollout, _ = disturbed_rollout(machines, stop, TICKS // 2)
    assert_identical(undisturbed, rollout)
    for timer in timers:
        timer.join()


def test_tuning_is_bit_identical(machines):
    target = np.tile(ROBOT.settings.target, (3, 1))
    moves = Moves(0.7 * ROBOT.start + 0.3 * target, target, ("a", "b", "c"))
    options = {"generations": 2, "population": 4, "seconds": 0.1, "moves": moves}
    for seed in range(SEEDS):
        ours = tune(ROBOT, seed=seed, workers=0, **options)
        theirs = tune(ROBOT, seed=seed, cluster=machines.ensure(3).options(1 + seed % 3), **options)
        assert ours.history == theirs.history
        np.testing.assert_array_equal(ours.params.kp, theirs.params.kp)
