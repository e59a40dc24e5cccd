"""Robots without collision shapes: the same free motion, and the contacts that they would have had."""

import functools
import os
import signal
import warnings

import numpy as np
import pytest
import tiny_urdf
from identical import assert_identical
from robots import RUBBING, load_bundled

import batchpid
from batchpid.errors import InvalidArgumentError
from batchpid.sim import MissedContactWarning, Randomization, Robot, Runner, Uniform
from batchpid.sim.engine.link_reach import DEPTH
from batchpid.sim.engine.physics import PHYSICS
from batchpid.sim.engine.protocol import SceneSpec
from batchpid.sim.engine.robot_model import scene_model
from batchpid.sim.options import default_params
from batchpid.sim.tuning import random_moves

BOX = '<collision><geometry><box size="0.1 0.1 0.4"/></geometry></collision>'
TICKS = 15


@pytest.fixture(scope="module")
def falling(tmp_path_factory):
    """A robot without <inertial>, on a column 0.3 m high, that falls over: its arm is then below the ground."""
    path = tmp_path_factory.mktemp("falling") / "falling.urdf"
    limit = '<limit lower="-3" upper="3" effort="10" velocity="2"/>'
    arm = BOX.replace("<geometry>", '<origin xyz="0 0 0.5"/><geometry>')
    hinge = tiny_urdf.joint("hinge", "base", "arm", inner=limit, origin="0 0 0.3")
    path.write_text(tiny_urdf.robot(tiny_urdf.link("base"), tiny_urdf.link("arm", arm), hinge))
    return Robot.load(path)


def roll_out(robot, start, target, ticks=TICKS, **options):
    with Runner(robot, len(start), workers=options.pop("workers", 0), **options) as runner:
        runner.reset(start)
        rollout = runner.rollout(np.broadcast_to(target, (ticks, *np.shape(target))))
        return rollout, runner.missed_contacts


@functools.cache
def free_moves(name):
    return random_moves(load_bundled(name), 4, seed=1)


@pytest.mark.parametrize(
    ("name", "control", "physics"),
    [
        ("panda", "pid", "accurate"),
        pytest.param("panda", "drive", "fast", marks=pytest.mark.slow),
        pytest.param("jaco2", "pid", "free", marks=pytest.mark.slow),
        pytest.param(RUBBING, "pid", "accurate", marks=pytest.mark.slow),
        (RUBBING, "drive", "fast"),
    ],
)
def test_free_motion_is_bit_identical_to_that_of_the_shaped_robot(name, control, physics):
    robot, moves = load_bundled(name), free_moves(name)
    options = {"physics": physics, "control": control, "params": default_params(robot, control)}
    shaped, _ = roll_out(robot, moves.start, moves.target, **options)
    bare, missed = roll_out(robot, moves.start, moves.target, collisions=False, **options)
    assert np.abs(bare.qpos[-1] - moves.start).max() > 0.01
    assert_identical(bare, shaped)
    assert not missed


@pytest.mark.parametrize(
    "options",
    [
        pytest.param(
            {
                "randomization": Randomization(
                    payload=Uniform(0.0, 1.0), link_mass=Uniform(1.0, 2.0), friction=Uniform(0, 1)
                )
            },
            marks=pytest.mark.slow,
        ),
        {"guard": True},
        pytest.param({"actuators": batchpid.make_actuators(9, command_delay=0.002)}, marks=pytest.mark.slow),
    ],
    ids=lambda options: next(iter(options)),
)
def test_free_motion_is_bit_identical_with_other_options_too(panda, options):
    moves = free_moves("panda")
    shaped, _ = roll_out(panda, moves.start, moves.target, physics="fast", **options)
    bare, _ = roll_out(panda, moves.start, moves.target, physics="fast", collisions=False, **options)
    assert_identical(bare, shaped)


@pytest.mark.slow
def test_any_number_of_workers(jaco2):
    start = jaco2.sample(11, seed=0)
    effort = np.random.default_rng(0).choice([-1, 1], start.shape) * jaco2.effort_limit  # into links and limits
    thrash = {"control": "effort", "physics": "free", "collisions": False}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        expected, missed = roll_out(jaco2, start, effort, **thrash)
        found, also = roll_out(jaco2, start, effort, **thrash, workers=2)
    assert (expected.qpos[-1] >= jaco2.upper - 1e-3).any()
    assert_identical(found, expected)
    assert missed
    assert also == missed


def test_masses_and_inertias_stay(falling):
    specs = [
        SceneSpec(falling.urdf, (), falling.joints, 1e-3, PHYSICS["fast"], collisions=collisions)
        for collisions in (True, False)
    ]
    shaped, bare = (scene_model(spec).mass_matrix(np.array([[0.5]])) for spec in specs)
    np.testing.assert_allclose(bare, shaped, rtol=1e-6)
    assert 1.0 < bare[0, 0, 0] < 2.0  # 4 kg (1000 kg/m^3) at 0.5 m, not the 1e-6 kg of a link without shapes


@pytest.mark.parametrize("name", ["panda", pytest.param("jaco2", marks=pytest.mark.slow)])
def test_missed_contacts_are_those_found_by_looking_at_every_tick(name):
    robot = load_bundled(name)
    start, target = robot.sample(16, seed=2), robot.sample(16, seed=3)
    with pytest.warns(MissedContactWarning, match="env .* at .* s"):
        rollout, missed = roll_out(robot, start, target, ticks=30, collisions=False)
    spec = SceneSpec(robot.urdf, robot.ignored_pairs, robot.joints, 1e-3, PHYSICS["fast"], ground=robot.has_ground)
    model, expected = scene_model(spec), {}
    for time, poses in zip(rollout.time, rollout.qpos, strict=True):
        for env in np.flatnonzero(model.in_contact(poses, -DEPTH)).tolist():
            expected.setdefault(env, (time, model.nearest_links(poses[env])))
    assert expected
    assert {contact.env: (pytest.approx(contact.time), contact.links) for contact in missed} == expected
    assert rollout.ok.all()


def test_one_warning_names_envs_and_links(falling):
    with Runner(falling, 3, workers=0, collisions=False, compensate="none", control="effort") as runner:
        runner.reset([[0.0], [1.5], [0.0]])
        with pytest.warns(MissedContactWarning, match=r"env 1: 'arm' and the ground at 0\.\d* s\. ") as caught:
            runner.rollout(np.zeros((40, 1)))
        assert len(caught) == 1
        assert runner.observe().ok.all()
        (first,) = runner.missed_contacts
        assert (first.env, first.links) == (1, ("arm",))
        runner.reset([[0.0], [1.5], [0.0]])
        runner.rollout(np.zeros((40, 1)))  # no further warning, which would be an error
        assert [contact.env for contact in runner.missed_contacts] == [1, 1]


@pytest.mark.slow
def test_checkpoints_and_lost_workers_do_not_change_what_was_missed(jaco2):
    start, target = jaco2.sample(8, seed=2), jaco2.sample(8, seed=3)

    def missed(**options):
        with Runner(jaco2, 8, collisions=False, physics="free", **options) as runner, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            runner.reset(start)
            for tick in range(12):
                runner.step(target)
                if options["workers"] and tick == 7:
                    os.kill(runner.pids[0], signal.SIGKILL)
            return runner.missed_contacts

    expected = missed(workers=0)
    assert expected
    assert missed(workers=0, checkpoint_steps=60) == expected
    assert missed(workers=1, checkpoint_steps=60) == expected


def test_snapshots_continue_bit_identically(jaco2):
    with Runner(jaco2, 3, workers=0, collisions=False) as runner:
        runner.step(jaco2.settings.target)
        snapshot = runner.snapshot()
        expected = runner.step(jaco2.settings.target)
        runner.restore(snapshot)
        assert_identical(runner.step(jaco2.settings.target), expected)
        assert runner.info.collisions is False
    with Runner(jaco2, 3, workers=0) as runner, pytest.raises(InvalidArgumentError, match="collisions"):
        runner.restore(snapshot)


def add_box(scene, env):
    return scene.create_actor_builder().add_box_collision(half_size=[0.1, 0.1, 0.1]).build(name="box")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"ground": True}, "ground: is True, and collisions are False"),
        ({"build": add_box}, r"build, env 0: added collision shapes \(to 'box'\)"),
        ({"collisions": "no"}, "collisions"),
    ],
)
def test_options_without_meaning_are_refused(panda, options, message):
    with pytest.raises(InvalidArgumentError, match=message):
        Runner(panda, 2, **{"workers": 0, "collisions": False, **options})


def test_a_floating_base_is_refused(falling):
    floating = Robot.load(falling.path, fixed_base=False)
    with pytest.raises(InvalidArgumentError, match="collisions: are False, and nothing holds the floating base"):
        Runner(floating, 1, workers=0, collisions=False)


def test_content_without_shapes_is_allowed(panda):
    with Runner(panda, 2, workers=0, collisions=False, build=lambda scene, env: "panda_hand") as runner:
        runner.step(panda.settings.target)
        assert runner.poses().shape == (2, 1, 7)
