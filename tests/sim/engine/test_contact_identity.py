"""In contact, too, at many places at once and without order, how envs are grouped changes no byte."""

from __future__ import annotations

import functools
import os
import signal
import warnings

import numpy as np
import pytest
from identical import assert_identical
from robots import load_bundled

from sim import RecoveryWarning, Robot, Runner
from sim.engine.contact_prediction import ContactPredictor
from sim.tuning.randomization import draw_variation

N, TICKS = 16, 20
OPEN_LOOP = {"kp": 0.0, "ki": 0.0, "kd": 0.0}


def thrash(name="jaco2", *, envs=N, before=None, **options):
    """Random efforts: fingers hit each other and the hand, at several places at once."""
    model = load_bundled(name)
    effort = np.random.default_rng(0).normal(size=(TICKS, envs, model.dof)) * model.effort_limit
    options = {"params": model.params(**OPEN_LOOP), "control": "effort", "workers": 0} | options
    with Runner(model, envs, **options) as runner:
        if before is not None:
            before(runner)
        rollout = runner.rollout(effort)
        return rollout, isolated(runner)


def isolated(runner):
    """How many robots have a system of their own; None where they live in other processes."""
    loops = [getattr(worker, "_loop", None) for worker in runner._pool.workers]
    return None if None in loops else sum(int(group.pack.isolated.sum()) for group in loops[0].groups)


@functools.cache
def reference(name="jaco2", physics="accurate"):
    """Every env in a system of its own from the start."""
    return thrash(name, physics=physics, pack_size=1)[0]


@pytest.mark.parametrize("physics", ["accurate", "fast"])
@pytest.mark.parametrize("name", ["jaco2", "panda"])
@pytest.mark.parametrize("options", [{"pack_size": 8}, {"pack_size": 4, "workers": 2}], ids=str)
def test_any_packing(name, physics, options):
    assert_identical(thrash(name, physics=physics, **options)[0], reference(name, physics))


def test_without_systems_of_their_own_they_differ(monkeypatch):
    """The efforts above are such that it takes isolation; without it this test's neighbours could not fail."""
    monkeypatch.setattr(ContactPredictor, "predicts_contact", lambda *_: False)
    shared = thrash(pack_size=8, envs=64)[0]
    assert (shared.qpos != thrash(pack_size=1, envs=64)[0].qpos).any()


@pytest.mark.parametrize("name", ["jaco2", "panda"])
def test_falling_limply_onto_the_ground(name):
    model = load_bundled(name)
    poses = model.sample(N, seed=1)

    def fall(pack_size):
        return thrash(
            name,
            pack_size=pack_size,
            compensate="none",
            params=model.params(**OPEN_LOOP, effort_limit=1e-6),
            before=lambda runner: runner.reset(poses),
        )[0]

    first = fall(1)
    assert np.abs(first.qpos[-1] - poses).max() > 0.3
    assert_identical(fall(8), first)


def test_a_floating_base():
    """It lies on the ground from the start, so it has a system of its own, like any other that does."""
    model = Robot.load("panda", fixed_base=False)
    effort = np.random.default_rng(0).normal(size=(TICKS, N, model.dof)) * model.effort_limit
    runs = []
    for pack_size, workers in ((1, 0), (8, 0), (4, 2)):
        options = {"control": "effort", "params": model.params(**OPEN_LOOP), "workers": workers}
        with Runner(model, N, pack_size=pack_size, **options) as runner:
            runs.append(runner.rollout(effort))
    assert_identical(runs[1], runs[0])
    assert_identical(runs[2], runs[0])


def test_an_env_alone_and_among_others():
    model, alone = load_bundled("jaco2"), reference().qpos[:, :1]
    effort = np.random.default_rng(0).normal(size=(TICKS, N, model.dof)) * model.effort_limit
    with Runner(model, 1, workers=0, control="effort", params=model.params(**OPEN_LOOP)) as runner:
        np.testing.assert_array_equal(runner.rollout(effort[:, :1]).qpos, alone)


def test_neighbours_of_an_env_that_fails():
    model = load_bundled("jaco2")
    effort = np.random.default_rng(0).normal(size=(TICKS, N, model.dof)) * model.effort_limit
    effort[7, 5, 3] = np.nan
    options = {"control": "effort", "params": model.params(**OPEN_LOOP), "workers": 0, "pack_size": 8}
    with Runner(model, N, on_invalid_input="contain", **options) as runner, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        rollout = runner.rollout(effort)
    assert not rollout.ok[7:, 5].any()
    others = np.arange(N) != 5
    assert_identical(rollout, reference(), others)


def closed(name):
    """A fist: the fingers touch each other."""
    pose = load_bundled(name).start.copy()
    pose[7:] = load_bundled(name).upper[7:]
    return pose


def test_start_poses_that_touch_already():
    def start(runner):
        runner.reset(closed("jaco2"))
        assert isolated(runner) == N

    assert_identical(*(thrash(pack_size=size, before=start)[0] for size in (1, 8)))


def test_an_episode_depends_on_nothing_before_it():
    """Not even on how its contacts were ordered: a reset ends every past."""
    model = load_bundled("jaco2")
    effort = np.random.default_rng(0).normal(size=(TICKS, N, model.dof)) * model.effort_limit
    for start, alone in ((model.start, 0), (closed("jaco2"), N)):
        with Runner(model, N, control="effort", params=model.params(**OPEN_LOOP), workers=0) as runner:
            episodes = []
            for _ in range(3):
                runner.reset(start)
                assert isolated(runner) == alone
                episodes.append(runner.rollout(effort))
                assert isolated(runner) > 0
        assert_identical(episodes[1], episodes[0], skip=["time"])
        assert_identical(episodes[2], episodes[0], skip=["time"])


def test_free_motion_shares_systems():
    """What touches nothing does not pay for it."""
    for name in ("panda", "jaco2"):
        model = load_bundled(name)
        with Runner(model, 64, workers=0) as runner:
            runner.rollout(np.broadcast_to(model.settings.target, (50, model.dof)))
            assert isolated(runner) == 0


def test_a_drive_goes_on_where_it_was():
    """Targets, gains and limits of the engine's own drive move to the new system with the robot."""
    model, target = load_bundled("jaco2"), closed("jaco2")

    def close(pack_size):
        with Runner(model, N, control="drive", workers=0, pack_size=pack_size) as runner:
            return runner.rollout(np.broadcast_to(target, (60, model.dof))), isolated(runner)

    (first, alone), (second, taken_out) = close(1), close(8)
    assert alone == taken_out == N
    assert_identical(second, first)
    assert np.abs(first.qpos[-1, :, :6] - target[:6]).max() < 0.02


def test_payload_and_friction_stay():
    model = load_bundled("jaco2")
    variation = draw_variation(model, N, seed=2)
    runs = [thrash(variation=variation, recover=False, pack_size=size, checkpoint_steps=None) for size in (1, 8)]
    assert runs[0][1] == runs[1][1] > 0
    assert_identical(runs[1][0], runs[0][0])


def test_a_snapshot_amid_contact_is_the_same_barrier_for_all():
    model = load_bundled("jaco2")
    effort = np.random.default_rng(0).normal(size=(2 * TICKS, N, model.dof)) * model.effort_limit

    def run(pack_size, **options):
        options = {"control": "effort", "params": model.params(**OPEN_LOOP), "pack_size": pack_size} | options
        with Runner(model, N, workers=0, **options) as runner:
            runner.rollout(effort[:TICKS])
            snapshot = runner.snapshot()
            return runner.rollout(effort[TICKS:]), snapshot

    (first, snapshot), (second, other) = run(1), run(8)
    assert_identical(second, first)
    np.testing.assert_array_equal(other.states.isolated, snapshot.states.isolated)
    assert snapshot.states.isolated.any()
    with Runner(model, N, workers=2, control="effort", params=model.params(**OPEN_LOOP)) as runner:
        runner.restore(snapshot)
        assert_identical(runner.rollout(effort[TICKS:]), first)


def test_a_worker_killed_amid_contact():
    def kill(runner):
        runner.rollout(np.zeros((1, N, runner.robot.dof)))
        os.kill(runner.pids[1], signal.SIGKILL)

    def wait(runner):
        runner.rollout(np.zeros((1, N, runner.robot.dof)))

    expected, _ = thrash(checkpoint_steps=150, before=wait, pack_size=1)
    with pytest.warns(RecoveryWarning):
        found, _ = thrash(workers=2, checkpoint_steps=150, before=kill)
    assert_identical(found, expected)
