"""Floor and meshes on a page and in a film: the ground of physics, otherwise a grid at the lowest link."""

from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
from tiny_urdf import INERTIAL, joint, link, robot, write

from batchpid.sim import Robot, Runner, read_recording, write_recording
from batchpid.sim.view import LiveSimulation, Playback
from batchpid.sim.view.layout import arrange_robots
from batchpid.sim.view.renderer import add_floor
from batchpid.sim.view.scene import RobotScene

pytest.importorskip("trimesh")
LEG = '<collision><origin xyz="0 0 -0.2"/><geometry><box size="0.1 0.1 0.4"/></geometry></collision>'


@pytest.fixture
def hanging(tmp_path):
    """A robot whose leg hangs below its fixed base, to -0.5 m: no ground by default."""
    parts = link("pelvis"), link("leg", INERTIAL + LEG), joint("hip", "pelvis", "leg", origin="0 0 -0.1")
    return Robot.load(write(tmp_path, robot(*parts)))


def drawn(described, ground):
    """Return the calls by which the surroundings of two robots are drawn, and the camera."""
    server = SimpleNamespace(scene=MagicMock(), initial_camera=SimpleNamespace(), atomic=MagicMock())
    RobotScene(server, described, ("pid",), 2, ground)
    return server.scene, server.initial_camera


def test_the_ground_of_physics_is_drawn_at_height_0(panda, hanging):
    for described in (panda, hanging):
        scene, camera = drawn(described, ground=True)
        assert not scene.add_grid.called
        assert scene.add_image.call_args.kwargs["position"][2] == 0.0
        assert camera.look_at[2] > 0


def test_without_one_a_grid_is_drawn_at_the_lowest_link(panda, hanging):
    for described, height in ((panda, 0.0), (hanging, -0.5)):
        scene, camera = drawn(described, ground=False)
        assert not scene.add_image.called
        assert scene.add_grid.call_args.kwargs["position"][2] == pytest.approx(height, abs=1e-3)
        above = drawn(described, ground=True)[1]
        assert np.subtract(above.look_at, camera.look_at)[2] == pytest.approx(-height, abs=1e-3)
        assert np.subtract(above.position, camera.position)[2] == pytest.approx(-height, abs=1e-3)


@pytest.mark.parametrize(("options", "ground"), [({}, False), ({"ground": True}, True), ({"collisions": False}, False)])
def test_a_page_shows_the_ground_of_the_runner_and_of_the_recording(options, ground, hanging, tmp_path):
    live = LiveSimulation(hanging, 1, workers=0, **options)
    live.close()
    assert live.ground is live.frame().info.ground is ground
    with Runner(hanging, 1, workers=0, **options) as runner:
        rollout = runner.rollout(np.zeros((1, 1)))
    read = read_recording(write_recording(rollout, tmp_path / "run.h5"))
    assert Playback(read, hanging).ground is ground


def test_an_older_recording_has_the_default_ground(panda, hanging):
    for described in (panda, hanging):
        with Runner(described, 1, workers=0, collisions=False) as runner:
            rollout = runner.rollout(described.start[None])
        vars(rollout.info)["ground"] = None
        assert Playback(rollout, described).ground is described.has_ground


def test_a_film_has_the_same_floor(hanging):
    for ground, height in ((True, 0.0), (False, -0.5)):
        scene = MagicMock()
        layout = arrange_robots(hanging, 1, 2, ground)
        add_floor(scene, layout, ground, None)
        assert scene.add_ground.called == ground
        lines = scene.create_actor_builder.return_value.add_box_visual.call_args_list
        assert bool(lines) != ground
        assert layout.floor == pytest.approx(height, abs=1e-3)
        for line in lines:
            pose, half_size, _ = line.args
            assert pose.p[2] == pytest.approx(height, abs=1e-3)
            assert sorted(np.asarray(half_size) > 0.1) == [False, False, True]
