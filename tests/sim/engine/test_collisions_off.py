"""Robots without collision shapes: the same free motion, and the contacts that they would have
had.
"""

import numpy as np
import pytest
import tiny_urdf
from identical import assert_identical
from robots import RUBBING, load_bundled

import batchpid
from batchpid.sim import MissedContactWarning, Randomization, Robot, Runner, Uniform
from batchpid.sim.tuning import random_moves

BOX = '<collision><geometry><box size="0.1 0.1 0.4"/></geometry></collision>'
TICKS = 15


@pytest.fixture(scope="module")
def falling(tmp_path_factory):
    """A robot without <inertial>, on a column 0.3 m high, that falls over: its arm is then below
    the ground.
    """
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


@pytest.mark.quick_rows(3)
@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("panda", {"physics": "accurate"}),
        ("panda", {"guard": True}),
        ("panda", {"actuators": batchpid.make_actuators(9, command_delay=0.002)}),
        ("panda", {"randomization": Randomization(payload=Uniform(0, 1), link_mass=Uniform(1, 2))}),
        ("jaco2", {"physics": "fast"}),
        (RUBBING, {"control": "drive", "physics": "fast"}),
    ],
    ids=str,
)
def test_free_motion_is_bit_identical_to_that_of_the_shaped_robot(name, options):
    robot = load_bundled(name)
    moves, options = random_moves(robot, 4, seed=1), {"physics": "fast", **options}
    shaped, _ = roll_out(robot, moves.start, moves.target, **options)
    bare, missed = roll_out(robot, moves.start, moves.target, collisions=False, **options)
    assert np.abs(bare.qpos[-1] - moves.start).max() > 0.01
    assert_identical(bare, shaped)
    assert not missed


def test_masses_and_inertias_stay(falling):
    """Those of 4 kg (1000 kg/m^3) at 0.5 m, not the 1e-6 kg of a link without shapes."""
    options = {"control": "effort", "compensate": "none", "ground": False}
    shaped, bare = (
        roll_out(falling, [[0.5]], [1.0], collisions=given, **options)[0] for given in (True, False)
    )
    np.testing.assert_allclose(bare.qpos, shaped.qpos, rtol=1e-5)
    assert 0.1 < bare.qpos[-1, 0, 0] - 0.5 < 1.0


@pytest.mark.parametrize("name", ["panda", pytest.param("jaco2", marks=pytest.mark.slow)])
def test_missed_contacts_are_those_found_by_looking_at_every_tick(name):
    robot = load_bundled(name)
    start, target = robot.sample(16, seed=2), robot.sample(16, seed=3)
    with pytest.warns(MissedContactWarning, match="env .* at .* s"):
        rollout, missed = roll_out(robot, start, target, ticks=30, collisions=False)
    dynamics, expected = robot.dynamics(), {}
    for time, poses in zip(rollout.time, rollout.qpos, strict=True):
        for env in np.flatnonzero(dynamics.in_contact(poses, -1e-3)).tolist():
            expected.setdefault(env, time)
    assert expected
    assert {contact.env: pytest.approx(contact.time) for contact in missed} == expected
    assert rollout.ok.all()


def test_one_warning_names_envs_and_links(falling):
    with Runner(
        falling, 3, workers=0, collisions=False, compensate="none", control="effort"
    ) as runner:
        runner.reset([[0.0], [1.5], [0.0]])
        with pytest.warns(
            MissedContactWarning, match=r"env 1: 'arm' and the ground at 0\.\d* s\. "
        ) as caught:
            runner.rollout(np.zeros((40, 1)))
        assert len(caught) == 1
        assert runner.observe().ok.all()
        (first,) = runner.missed_contacts
        assert (first.env, first.links) == (1, ("arm",))
        runner.reset([[0.0], [1.5], [0.0]])
        runner.rollout(np.zeros((40, 1)))  # no further warning, which would be an error
        assert [contact.env for contact in runner.missed_contacts] == [1, 1]


def test_content_without_shapes_is_allowed(panda):
    with Runner(
        panda, 2, workers=0, collisions=False, build=lambda scene, env: "panda_hand"
    ) as runner:
        runner.step(panda.settings.target)
        assert runner.poses().shape == (2, 1, 7)
