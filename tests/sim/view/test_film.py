"""SAPIEN's renderer: films where it works, and a clear word where it does not."""

import os

import numpy as np
import pytest

from batchpid.errors import InvalidArgumentError
from sim import Robot, Runner
from sim.cli import main
from sim.view import film as renderer


@pytest.fixture(scope="module")
def run():
    robot = Robot.load("panda")
    with Runner(robot, 3, workers=0) as runner:
        return robot, runner.rollout(np.broadcast_to(robot.settings.target, (20, robot.dof)))


def test_without_a_device_it_says_what_to_do(run, tmp_path, monkeypatch):
    pytest.importorskip("imageio_ffmpeg")
    robot, rollout = run
    monkeypatch.setattr(renderer, "problem", lambda: "RuntimeError: failed to find a rendering device")
    with pytest.raises(
        renderer.RenderError, match=r"failed to find a rendering device.*mesa-vulkan-drivers.*batchpid view"
    ):
        renderer.film(rollout, robot, tmp_path / "film.mp4")
    assert not list(tmp_path.iterdir())


def test_the_probe_survives_whatever_a_try_does(monkeypatch):
    for program, said in (
        ("import os; os.abort()", "status -6"),
        ("raise RuntimeError('no device')", "no device"),
        ("print('rendered', flush=True); import os; os.abort()", None),
    ):
        renderer.problem.cache_clear()
        monkeypatch.setattr(renderer, "_PROBE", program)
        found = renderer.problem()
        assert found is None if said is None else said in found
    renderer.problem.cache_clear()


def test_bad_arguments_are_named(run, tmp_path):
    robot, rollout = run
    for options, named in (({"out": "film.avi"}, "out"), ({"fps": 0.0}, "fps"), ({"width": 3}, "width")):
        with pytest.raises(InvalidArgumentError, match=named):
            renderer.film(rollout, robot, **({"out": tmp_path / "film.mp4"} | options))


def test_frames_follow_the_recorded_time(run):
    _, rollout = run
    assert renderer._rows(rollout, 0.02).tolist() == list(range(0, 20, 2))
    assert renderer._rows(rollout, 0.005)[:5].tolist() == [0, 1, 1, 2, 2]


def test_a_film_of_a_rollout(run, tmp_path, monkeypatch):
    imageio = pytest.importorskip("imageio.v2")
    pytest.importorskip("imageio_ffmpeg")
    if renderer.problem() is not None:
        pytest.skip("needs a Vulkan device")
    monkeypatch.chdir(tmp_path)
    assert main(["rollout", "--num-envs", "2", "--seconds", "0.3", "--workers", "0", "--out", "run.npz"]) == 0
    assert main(["render", "run.npz", "--out", "film.mp4", "--width", "320", "--height", "180"]) == 0
    frames = np.array([frame for frame in imageio.get_reader("film.mp4")])
    assert frames.shape[1:] == (180, 320, 3)
    assert 8 <= len(frames) <= 10
    assert frames[0].std() > 5  # there is something on it
    assert np.abs(frames[-1].astype(int) - frames[0]).max() > 40  # and it moves


def test_the_window_plays_until_its_time_is_up(run):
    if not os.environ.get("DISPLAY") or renderer.problem() is not None:
        pytest.skip("needs a display and a Vulkan device")
    robot, rollout = run
    renderer.window(rollout, robot, seconds=1.0)


def test_the_demos_viewer_says_at_once_that_it_cannot(monkeypatch, capsys):
    monkeypatch.setattr(renderer, "problem", lambda: "no device")
    assert main(["demo", "--viewer"]) == 2
    said = capsys.readouterr()
    assert "batchpid view" in said.err
    assert not said.out
