"""The caller's own controllers: called at every sim step, with a state that resets, snapshots and recovery keep."""

from __future__ import annotations

import os
import signal
from typing import NamedTuple

import numpy as np
import pytest
from identical import assert_identical

import batchpid as bp
from batchpid.errors import InvalidArgumentError
from sim import Runner, Snapshot
from sim.loop.custom import flatten, unflatten

N, TICKS = 5, 12


class Law:
    """batchpid's own law with the passive force as feedforward: what control="pid" does with gains in efforts."""

    def __init__(self, params):
        self.params, self.k = params, None

    def init(self, robot, num_envs):
        return bp.init(self.params, np.tile(robot.start, (num_envs, 1)).astype(np.float32))

    def __call__(self, state, setpoint, qpos, qvel, passive):
        k = bp.discretise(self.params, 1 / 2000, len(qpos))
        return bp.advance(k, state, setpoint, qpos, None, None, passive)


class Counter:
    """Efforts from a state of several parts: the number of steps, and a filtered velocity."""

    def init(self, robot, num_envs):
        return {"steps": np.zeros(num_envs), "filter": (np.zeros((num_envs, robot.dof)), None)}

    def __call__(self, state, setpoint, qpos, qvel, passive):
        steps, filtered = state["steps"] + 1, 0.9 * state["filter"][0] + 0.1 * qvel
        wave = np.sin(0.01 * steps)[:, None]
        return {"steps": steps, "filter": (filtered, None)}, passive + 5 * wave * setpoint - 0.5 * filtered


def rollout(robot, controller, **options):
    rng = np.random.default_rng(1)
    with Runner(robot, N, control=controller, **({"workers": 0, "substeps": 10} | options)) as runner:
        setpoints = robot.start + rng.uniform(-0.1, 0.1, (TICKS, N, robot.dof))
        return runner.rollout(np.clip(setpoints, robot.lower, robot.upper))


def test_the_law_as_a_controller_is_the_pid(panda):
    params = panda.params(setpoint_weight=0.5)
    ours = rollout(panda, Law(params), params=params)
    theirs = rollout(panda, "pid", params=params, compensate="gravity+coriolis")
    assert_identical(ours, theirs)
    assert ours.info.control == "Law"
    assert np.ptp(ours.qpos, axis=0).max() > 0.01


@pytest.mark.parametrize("options", [{"workers": 2}, {"pack_size": 1}, {"num_envs": 3}], ids=str)
def test_any_workers_and_packing_are_bit_identical(panda, options):
    if "num_envs" in options:
        with Runner(panda, 3, control=Counter(), workers=0, substeps=10) as runner:
            few = runner.rollout(np.ones((TICKS, 3, panda.dof)))
        with Runner(panda, N, control=Counter(), workers=0, substeps=10) as runner:
            assert_identical(few, runner.rollout(np.ones((TICKS, N, panda.dof))).for_envs(slice(0, 3)))
    else:
        assert_identical(rollout(panda, Counter(), **options), rollout(panda, Counter()))


def test_resets_by_mask_and_snapshots_keep_the_state(panda, tmp_path):
    with Runner(panda, N, control=Counter(), workers=0, substeps=10) as runner:
        runner.step(np.ones(panda.dof))
        runner.reset(mask=np.arange(N) < 2)
        snapshot = runner.snapshot()
        np.testing.assert_array_equal(snapshot.states.controller["steps"], [0, 0, 10, 10, 10])
        assert snapshot.states.controller["filter/0"].shape == (N, panda.dof)
        snapshot.save(tmp_path / "state.npz")
        expected = runner.rollout(np.ones((3, panda.dof)))
    with Runner(panda, N, control=Counter(), workers=0, substeps=10) as runner:
        runner.restore(Snapshot.load(tmp_path / "state.npz"))
        assert_identical(runner.rollout(np.ones((3, panda.dof))), expected, skip={"time"})
    other = Runner(panda, N, control=Law(panda.params()), workers=0)
    with other, pytest.raises(InvalidArgumentError, match="control 'Counter', not 'Law'"):
        other.restore(snapshot)


@pytest.mark.filterwarnings("ignore::sim.RecoveryWarning")
def test_a_lost_worker_is_replaced(panda):
    setpoints = np.ones((2, panda.dof))
    with Runner(panda, N, control=Counter(), workers=2, substeps=10) as runner:
        first = runner.rollout(setpoints)
        os.kill(runner.pids[0], signal.SIGKILL)
        second = runner.rollout(setpoints)
        assert runner.recoveries == 1
    with Runner(panda, N, control=Counter(), workers=0, substeps=10) as runner:
        assert_identical(runner.rollout(setpoints), first)
        assert_identical(runner.rollout(setpoints), second)


class WrongState(Counter):
    def init(self, robot, num_envs):
        return {"steps": np.zeros(3)}


class WrongEffort(Counter):
    def __call__(self, *_):
        return None, np.zeros(4)


class DivergesInOneEnv(Counter):
    def __call__(self, state, setpoint, qpos, qvel, passive):
        state, effort = super().__call__(state, setpoint, qpos, qvel, passive)
        return state, np.where((state["steps"] == 15)[:, None] & (setpoint > 1), np.nan, effort)


def test_what_does_not_fit_is_an_error(panda):
    with pytest.raises(InvalidArgumentError, match=r"control.*'pid'"):
        Runner(panda, 2, control=print, workers=0)
    with pytest.raises(InvalidArgumentError, match=r"init returned a state steps of shape \(3,\), for 5 envs"):
        Runner(panda, N, control=WrongState(), workers=0)
    runner = Runner(panda, N, control=WrongEffort(), workers=0)
    with runner, pytest.raises(InvalidArgumentError, match=r"returned an effort of shape \(4,\), not \(5, 9\)"):
        runner.step(np.zeros(panda.dof))


@pytest.mark.filterwarnings("ignore::sim.FaultWarning")
def test_an_env_whose_effort_is_nan_fails_alone(panda):
    setpoint = np.ones((N, panda.dof))
    with Runner(panda, N, control=Counter(), workers=0, substeps=20) as runner:
        sound = runner.step(setpoint)
    with Runner(panda, N, control=DivergesInOneEnv(), workers=0, substeps=20) as runner:
        setpoint[3] = 1.5
        obs = runner.step(setpoint)
    np.testing.assert_array_equal(obs.ok, np.arange(N) != 3)
    assert_identical(obs, sound, np.arange(N) != 3)


def test_efforts_are_limited(panda):
    class Strong(Counter):
        def __call__(self, state, *_):
            return state, np.full((len(state["steps"]), panda.dof), 1e4)

    with Runner(panda, 2, control=Strong(), workers=0) as runner:
        obs = runner.step(np.zeros(panda.dof))
    assert obs.saturated.all()
    np.testing.assert_allclose(obs.effort, np.tile(panda.effort_limit, (2, 1)), rtol=1e-6)


class Pair(NamedTuple):
    first: object
    second: object


@pytest.mark.parametrize("state", [None, np.arange(3), (np.arange(3), None), {"a": Pair(np.ones(2), [np.zeros(2)])}])
def test_states_are_taken_apart_and_put_together(state):
    leaves = flatten(state)
    again = unflatten(state, leaves)
    assert str(again) == str(state)
    assert type(again) is type(state)
    assert len(set(leaves)) == len(leaves)
