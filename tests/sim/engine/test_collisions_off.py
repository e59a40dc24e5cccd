"""Robots without collision shapes: the same free motion, and nothing in their way."""

import numpy as np
import pytest
import tiny_urdf
from identical import assert_identical
from robots import RUBBING, load_bundled

import batchpid
from batchpid.sim import Randomization, Robot, Runner, Uniform
from batchpid.sim.tuning.moves import random_moves

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
        return rollout


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
    shaped = roll_out(robot, moves.start, moves.target, **options)
    bare = roll_out(robot, moves.start, moves.target, collisions=False, **options)
    assert np.abs(bare.qpos[-1] - moves.start).max() > 0.01
    assert_identical(bare, shaped)


def test_masses_and_inertias_stay(falling):
    """Those of 4 kg (1000 kg/m^3) at 0.5 m, not the 1e-6 kg of a link without shapes."""
    options = {"control": "effort", "compensate": "none", "ground": False}
    shaped, bare = (
        roll_out(falling, [[0.5]], [1.0], collisions=given, **options) for given in (True, False)
    )
    np.testing.assert_allclose(bare.qpos, shaped.qpos, rtol=1e-5)
    assert 0.1 < bare.qpos[-1, 0, 0] - 0.5 < 1.0


def test_robots_pass_through_the_ground_and_without_a_warning(falling):
    """A falling arm swings below the ground on which a robot with shapes stays."""
    options = {"control": "effort", "compensate": "none"}
    lowest = [
        roll_out(falling, [[1.5]], [0.0], ticks=40, collisions=given, **options).qpos.max()
        for given in (True, False)
    ]
    assert lowest[1] > lowest[0] + 0.3
