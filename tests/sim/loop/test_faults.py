"""Faults: an env that fails is reported with step and joint, and suspended or reset; the others are
bit-identical.
"""

import os
import warnings

import numpy as np
import pytest
from identical import assert_identical
from robots import load_bundled

from batchpid.sim import FaultWarning, Runner

PANDA = load_bundled("panda")
N = 6
OVERFLOW = 1e38
"""Effort [N m or N] that is finite, and makes the engine's state infinite or NaN in one sim
step.
"""
CASES = int(os.environ.get("BATCHPID_SOAK_FAULTS", "100"))


def setpoints(ticks, num_envs=N, seed=0):
    noise = np.random.default_rng(seed).uniform(-0.3, 0.3, (ticks, num_envs, PANDA.dof))
    return np.clip(PANDA.settings.target + noise, PANDA.lower, PANDA.upper)


def make(num_envs=N, **options):
    options = {"workers": 0, "substeps": 4, "on_invalid_input": "contain"} | options
    if options.get("control", "pid") == "pid":
        options.setdefault("params", PANDA.params())
    return Runner(PANDA, num_envs, **options)


def assert_others_identical(first, second, env):
    assert_identical(first, second, np.arange(first.num_envs) != env)


@pytest.mark.usefixtures("engine")
@pytest.mark.parametrize("control", ["pid", "drive", "effort"])
def test_a_state_that_is_not_finite_is_detected_at_its_step(control):
    table = setpoints(8) if control != "effort" else np.zeros((8, N, 9))
    forward = np.zeros((8, N, 9))
    options = {"control": control, "params": PANDA.params(effort_limit=None)}
    with make(**options) as runner:
        clean = runner.rollout(table, feedforwards=forward)
    forward[3, 2, 6] = OVERFLOW
    with make(**options) as runner, pytest.warns(FaultWarning, match="env 2"):
        broken = runner.rollout(table, feedforwards=forward)
    assert_others_identical(clean, broken, 2)
    (fault,) = runner.faults
    assert (fault.env, fault.step, fault.cause) == (2, 3 * 4 + 1, "state")
    assert np.isfinite(broken.qpos).all()
    assert broken.ok[:3].all()
    assert not broken.ok[3:, 2].any()


@pytest.mark.usefixtures("engine")
@pytest.mark.filterwarnings("ignore::batchpid.sim.StabilityWarning")
def test_an_env_with_unstable_gains_is_suspended():
    gains = PANDA.params().kd.repeat(N, 0)
    gains[4, 6] = 1e9
    with make(params=PANDA.params(kd=gains, effort_limit=None), substeps=20) as runner:
        with pytest.warns(FaultWarning, match="env 4"):
            rollout = runner.rollout(setpoints(10))
        assert {fault.env for fault in runner.faults} == {4}
        assert runner.faults[0].cause == "state"
    assert not rollout.ok[-1, 4]
    assert rollout.ok[:, [0, 1, 2, 3, 5]].all()
    assert np.isfinite(rollout.qpos).all()


@pytest.mark.usefixtures("engine")
def test_a_suspended_env_stands_still_until_it_is_reset():
    table = setpoints(40)
    table[2, 1] = np.nan
    with make() as runner:
        with pytest.warns(FaultWarning):
            runner.rollout(table)
        qvel = runner.snapshot().rows["engine"][1, 9:18]  # of the robot itself, not as observed
        assert np.abs(qvel).max() < 1e-6
        obs = runner.reset(mask=~runner.observe().ok)
        assert obs.ok.all()
        np.testing.assert_allclose(obs.qpos[1], PANDA.start, atol=1e-6)
        after = runner.rollout(setpoints(10, seed=3))
        assert after.ok.all()
        assert np.abs(after.qpos[-1, 1] - PANDA.start).max() > 1e-3


@pytest.mark.usefixtures("engine")
def test_an_env_that_is_reset_after_a_fault_is_bit_identical_to_one_without():
    table = setpoints(20)
    with make() as runner:
        runner.rollout(table[:5])
        runner.reset(mask=np.arange(N) == 1)
        clean = runner.rollout(table)
    with make() as runner, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        runner.rollout(np.where((np.arange(N) == 1)[:, None], np.nan, table[:5]))
        runner.reset(mask=np.arange(N) == 1)
        again = runner.rollout(table)
    assert_identical(clean, again)


@pytest.mark.filterwarnings("ignore::batchpid.sim.FaultWarning")
@pytest.mark.parametrize("workers", [0, 2])
def test_a_fault_is_not_reported_again_after_the_reset_of_its_env(workers):
    with make(workers=workers) as runner:
        for env in (3, 1):
            bad = setpoints(1)[0]
            bad[env, 4] = np.nan
            runner.step(bad)
            runner.reset(mask=np.arange(N) == env)
        assert [fault.env for fault in runner.faults] == [3, 1]


@pytest.mark.usefixtures("engine")
def test_on_fault_reset_restarts_the_env_and_flags_one_tick():
    table = setpoints(10)
    table[4, 2, 0] = np.nan
    home = np.clip(PANDA.start + 0.1, PANDA.lower, PANDA.upper)
    with make(on_fault="reset") as runner:
        runner.reset(qpos=home)
        with pytest.warns(FaultWarning, match="; reset"):
            rollout = runner.rollout(table)
    assert rollout.ok[:, 2].tolist() == [tick != 4 for tick in range(10)]
    assert np.abs(rollout.qpos[4, 2] - home).max() < 0.02
    assert np.abs(rollout.qpos[9, 2] - home).max() > 0.02


CAUSES = ("setpoint", "setpoint_rate", "feedforward", "state")


def check_random_fault(case):
    """Make one env of 64 fail at a random tick and joint: it stands still, and the others are
    bit-identical.
    """
    random = np.random.default_rng(case)
    num_envs, ticks, cause = 64, 4, CAUSES[case % 4]
    env, tick, joint = (int(random.integers(count)) for count in (num_envs, ticks, PANDA.dof))
    bad = random.choice([OVERFLOW, -OVERFLOW] if cause == "state" else [np.nan, np.inf, -np.inf])
    rates, efforts = random.normal(size=(2, ticks, num_envs, PANDA.dof))
    commands = {
        "setpoints": setpoints(ticks, num_envs, case),
        "setpoint_rates": 0.1 * rates,
        "feedforwards": efforts,
    }
    options = {"substeps": int(random.integers(1, 4)), "params": PANDA.params(effort_limit=None)}
    with make(num_envs, **options) as runner:
        clean = runner.rollout(**commands)
    commands["feedforwards" if cause == "state" else f"{cause}s"][tick, env, joint] = bad
    with make(num_envs, **options) as runner, pytest.warns(FaultWarning, match=f"env {env}"):
        broken = runner.rollout(**commands)
    assert_others_identical(clean, broken, env)
    (fault,) = runner.faults
    assert (fault.env, fault.cause) == (env, cause)
    assert fault.time == pytest.approx(fault.step / 2000)
    assert broken.ok[:, env].tolist() == [k < tick for k in range(ticks)]
    if cause != "state":
        assert fault.step == tick * runner.substeps + 1
        assert fault.joint == PANDA.joint_names[joint]
        before = broken.qpos[tick - 1, env] if tick else np.float32(PANDA.start)
        held = broken.qpos[tick:, env]
        np.testing.assert_array_equal(held, np.broadcast_to(before, held.shape))
    for rows in (broken.qvel, broken.effort):
        assert not rows[tick:, env].any()
    assert np.isfinite(broken.qpos).all()
    assert np.isfinite(broken.effort).all()


@pytest.mark.quick_rows(4)
@pytest.mark.usefixtures("engine")
@pytest.mark.parametrize("case", range(4))
def test_the_other_63_of_64_envs_are_bit_identical(case):
    check_random_fault(case)


@pytest.mark.quick_rows(2)
@pytest.mark.usefixtures("needs_jax", "engine")
@pytest.mark.parametrize("control", ["pid", "effort"])
def test_a_state_that_is_finite_and_far_away_is_a_fault_at_the_same_step_for_every_executor(
    control, monkeypatch
):
    found = []
    for switch, backend in (("1", "numpy"), ("0", "numpy"), ("1", "jax")):
        monkeypatch.setenv("BATCHPID_NATIVE", switch)
        commands = setpoints(4, 4) if control == "pid" else np.zeros((4, 4, 9))
        forward = np.zeros((4, 4, 9))
        forward[1, 2, 5] = 1e30  # the robot is at about 1e20 rad after a sim step or two
        with make(
            4, control=control, params=PANDA.params(effort_limit=None), backend=backend
        ) as runner:
            with pytest.warns(FaultWarning, match="a position is beyond 1,000,000 rad or m"):
                rollout = runner.rollout(commands, feedforwards=forward)
            assert rollout.ok[:, 2].tolist() == [True, False, False, False]
            assert np.abs(rollout.qpos).max() < 10
            found.append([fault._replace(action="") for fault in runner.faults])
    assert len(found[0]) == 1
    assert found[0] == found[1] == found[2]


@pytest.mark.slow
def test_the_other_63_of_64_envs_are_bit_identical_in_many_cases():
    for case in range(4, CASES):
        check_random_fault(case)


@pytest.mark.filterwarnings("ignore::batchpid.sim.FaultWarning")
def test_a_fault_in_the_first_sim_step_is_reported():
    with make(2) as runner:
        runner.step(np.where([[True], [False]], np.nan, PANDA.start))
        assert [(fault.env, fault.step) for fault in runner.faults] == [(0, 1)]
