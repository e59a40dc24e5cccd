"""Pictures and films, drawn by Matplotlib."""

import dataclasses
import os
import subprocess

import numpy as np
import pytest
import trimesh
from tiny_urdf import INERTIAL, joint, link, robot, write

from batchpid.errors import BatchPIDError, InvalidArgumentError
from batchpid.sim import Robot, Runner
from batchpid.sim.view import film
from batchpid.sim.view.scene import RobotScene


@pytest.fixture(scope="module")
def rollout(panda):
    with Runner(panda, 3, params=panda.params(), workers=0) as runner:
        return runner.rollout(np.broadcast_to(panda.target, (20, panda.dof)))


@pytest.mark.parametrize("ground", [False, True])
def test_a_robot_is_drawn_where_it_is(panda, ground):
    painter = film.Painter(panda, 2, ground, (160, 90))
    start, target = panda.start, panda.target
    first = painter.picture(np.array([start, target]))
    second = painter.picture(
        np.array([target, np.full(panda.dof, np.nan)])
    )  # the second keeps its pose
    third = painter.picture(np.array([start, start]))
    assert first.std() > 5  # not empty
    assert (first == painter.picture(np.array([start, target]))).all()
    changes = [(first != other).any(-1) for other in (second, third)]
    assert all(change.any() for change in changes)
    assert not (changes[0] & changes[1]).any()  # each robot in its own place


def read_film(path, width, height):
    """Return the pictures of a film, (frames, height, width, 3)."""
    ffmpeg = pytest.importorskip("imageio_ffmpeg").get_ffmpeg_exe()
    command = [
        ffmpeg,
        "-v",
        "error",
        "-i",
        f"file:{path}",
        "-f",
        "rawvideo",
        "-pix_fmt",
        "rgb24",
        "-",
    ]
    data = subprocess.run(command, capture_output=True, check=True).stdout
    return np.frombuffer(data, np.uint8).reshape(-1, height, width, 3)


@pytest.mark.parametrize("name", ["film.mp4", "-film.mp4", "film.GIF"])
def test_a_film_has_its_pictures_in_order(name, rollout, tmp_path, monkeypatch):
    pytest.importorskip("imageio_ffmpeg")
    monkeypatch.chdir(tmp_path)
    film.write_film(rollout, name)
    frames = read_film(name, *film.SIZE)
    assert len(frames) == 7  # of 0.19 s
    differences = np.abs(frames.astype(int) - frames[0]).mean((1, 2, 3))
    assert differences[-1] > differences[3] > differences[1] > 0
    assert os.listdir(tmp_path) == [name]


def test_a_film_that_is_interrupted_leaves_the_older_one(rollout, tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    path = tmp_path / "film.mp4"
    path.write_text("older")

    def interrupted(rows):
        yield from rows[:5]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        film.write_film(rollout, path, progress=interrupted)
    assert path.read_text() == "older"
    assert os.listdir(tmp_path) == ["film.mp4"]


def test_the_message_of_ffmpeg_is_in_the_error(rollout, tmp_path, monkeypatch):
    pytest.importorskip("imageio_ffmpeg")
    monkeypatch.setitem(film.CODECS, ".mp4", "none")
    with pytest.raises(BatchPIDError, match=r"ffmpeg: .*none"):
        film.write_film(rollout, tmp_path / "film.mp4")
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("gap", [1e7, 1e12, np.inf])
def test_runs_that_no_film_can_hold_are_refused(rollout, gap, tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    far = dataclasses.replace(rollout, time=np.append(rollout.time[:-1], gap))
    empty = rollout.for_ticks(0, 0)
    for bad in (far, empty):
        with pytest.raises(InvalidArgumentError, match=r"rollout: (lasts|holds no tick)"):
            film.write_film(bad, tmp_path / "film.gif")
    with pytest.raises(InvalidArgumentError, match="holds no tick"):
        empty.plot()


def test_meshes_of_many_triangles_are_coarser(tmp_path):
    """A ball of 80,000 triangles, with the outline of the ball."""
    trimesh.creation.icosphere(6, radius=0.3).export(tmp_path / "ball.stl")
    mesh = '<visual><geometry><mesh filename="ball.stl"/></geometry></visual>'
    parts = [
        link("base"),
        link("ball", INERTIAL + mesh),
        joint("hinge", "base", "ball", origin="0 0 0"),
    ]
    described = Robot.load(write(tmp_path, robot(*parts)))
    (surface,) = RobotScene(described, 1, True, 12).surfaces
    painter = film.Painter(described, 1, True, (160, 90))
    cell = 0.05
    coarse = film.coarse(surface, cell)
    assert len(coarse.faces) < len(surface.faces) / 50
    np.testing.assert_allclose(coarse.vertices.min(0), surface.vertices.min(0), atol=cell)
    np.testing.assert_allclose(coarse.vertices.max(0), surface.vertices.max(0), atol=cell)
    # A pose far away leaves the floor alone.
    near, far = (
        painter.picture(described.start[None], np.array([[place, 0, 0, 1, 0, 0, 0]]))
        for place in (0.0, 1e38)
    )
    assert (near != far).any(-1).mean() > 0.02
    assert (far == painter.picture(described.start[None], np.eye(1, 7, 3) + 1e30)).all()


def test_another_format_is_refused(rollout):
    with pytest.raises(InvalidArgumentError, match="out: unknown file format"):
        film.write_film(rollout, "film.avi")
