"""Scene of the page and of films: a floor at the ground of physics or at the lowest link, and
robots on it.
"""

import numpy as np
import pytest
from tiny_urdf import INERTIAL, joint, link, robot, write

from batchpid.sim import Robot, Runner
from batchpid.sim.view import LiveSimulation, Playback
from batchpid.sim.view.scene import RobotScene

LEG = (
    '<collision><origin xyz="0 0 -0.2"/><geometry><box size="0.1 0.1 0.4"/></geometry></collision>'
)


@pytest.fixture
def hanging(tmp_path):
    """A robot whose leg hangs below its fixed base, to -0.5 m: no ground by default."""
    parts = (
        link("pelvis"),
        link("leg", INERTIAL + LEG),
        joint("hip", "pelvis", "leg", origin="0 0 -0.1"),
    )
    return Robot.load(write(tmp_path, robot(*parts)))


def test_the_floor_is_the_ground_or_at_the_lowest_link(panda, hanging):
    for described, height in ((panda, 0.0), (hanging, -0.5)):
        with_ground, without = (RobotScene(described, 2, ground, 12) for ground in (True, False))
        assert with_ground.floor == 0.0
        assert without.floor == pytest.approx(height, abs=1e-3)
        for point, lower in ((with_ground.target, without.target), (with_ground.eye, without.eye)):
            assert point[2] - lower[2] == pytest.approx(-height, abs=1e-3)


@pytest.mark.parametrize(
    ("options", "ground"), [({}, False), ({"ground": True}, True), ({"collisions": False}, False)]
)
def test_the_ground_is_that_of_the_run(options, ground, hanging):
    live = LiveSimulation(hanging, 1, workers=0, **options)
    live.close()
    assert live.ground is ground
    with Runner(hanging, 1, workers=0, **options) as runner:
        assert Playback(runner.rollout(np.zeros((1, 1))), hanging).ground is ground


def test_robots_stand_in_their_places_and_stay_there_without_a_finite_pose():
    quadruped = Robot.load("quadruped", fixed_base=False)
    scene = RobotScene(quadruped, 5, True, 12)
    gaps = np.linalg.norm(scene.positions[:, None] - scene.positions, axis=-1)[
        ~np.eye(5, dtype=bool)
    ]
    assert gaps.min() == pytest.approx(1.3 * scene.reach)
    np.testing.assert_allclose(scene.positions.mean(0), 0.0, atol=scene.reach)
    qpos = np.tile(quadruped.start, (5, 1))
    base = np.tile([1.0, 2.0, 3.0, 1, 0, 0, 0], (5, 1))
    first = scene.place(qpos)
    moved = scene.place(qpos, base)
    np.testing.assert_allclose(
        moved[..., :3] - first[..., :3], np.broadcast_to([1, 2, 3], moved[..., :3].shape)
    )
    qpos[1], base[2] = np.nan, np.inf
    np.testing.assert_array_equal(scene.place(qpos, base), moved)
