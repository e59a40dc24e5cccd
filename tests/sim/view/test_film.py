"""Films, by SAPIEN's renderer where it works and by Matplotlib where it does not; and its window."""

import os
import subprocess

import numpy as np
import pytest

from batchpid.errors import InvalidArgumentError
from batchpid.sim import Runner
from batchpid.sim.cli import main
from batchpid.sim.view import film, renderer
from batchpid.sim.view.film import PaintedScene


@pytest.fixture(scope="module")
def rollout(panda):
    with Runner(panda, 3, params=panda.params(), workers=0) as runner:
        return runner.rollout(np.broadcast_to(panda.settings.target, (20, panda.dof)))


@pytest.fixture
def no_device(monkeypatch):
    monkeypatch.setattr(renderer, "render_problem", lambda: "RuntimeError: failed to find a rendering device")


def test_without_a_device_the_error_gives_the_remedy(rollout, no_device):
    with pytest.raises(
        renderer.RenderError, match=r"failed to find a rendering device.*mesa-vulkan-drivers.*batchpid view"
    ):
        film.show_window(rollout)


def test_without_a_device_a_film_is_painted(tmp_path, monkeypatch, no_device):
    pytest.importorskip("imageio_ffmpeg")
    monkeypatch.chdir(tmp_path)
    assert main(["rollout", "--num-envs", "2", "--seconds", "0.2", "--workers", "0", "--out", "run.npz"]) == 0
    assert main(["plot", "run.npz", "--film", "film.mp4"]) == 0
    frames = read_film("film.mp4", 960, 540)
    assert 6 <= len(frames) <= 7
    assert frames[0].std() > 5  # not empty
    assert np.abs(frames[-1].astype(int) - frames[0]).max() > 40  # the robots move


@pytest.mark.parametrize("ground", [False, True])
def test_a_painted_robot_stands_where_it_is(panda, ground):
    scene = PaintedScene(panda, 2, ground)
    picture = scene.add_camera(160, 90)
    poses = np.array([panda.start, panda.settings.target])
    scene.place(poses)
    first = picture()
    scene.place(np.array([panda.settings.target, np.full(panda.dof, np.nan)]))  # the second keeps its pose
    second = picture()
    scene.place(np.array([panda.start, panda.start]))
    third = picture()
    scene.place(poses)
    changed = [(first != other).any(-1) for other in (second, third)]
    assert (first == picture()).all()
    assert all(each.any() for each in changed)
    assert not (changed[0] & changed[1]).any()  # each robot in its own place


@pytest.mark.parametrize(
    ("program", "problem"),
    [
        ("import os; os.abort()", "status -6"),
        ("raise RuntimeError('no device')", "no device"),
        ("print('rendered', flush=True); import os; os.abort()", None),
    ],
)
def test_a_crash_of_the_test_program_does_not_end_this_process(program, problem):
    found = renderer.render_problem(program)
    assert found is None if problem is None else problem in found


def test_bad_arguments_are_named(rollout, tmp_path):
    for options, named in (({"out": "film.avi"}, "out"), ({"fps": 0.0}, "fps"), ({"width": 3}, "width")):
        with pytest.raises(InvalidArgumentError, match=named):
            film.write_film(rollout, **({"out": tmp_path / "film.mp4"} | options))


def read_film(path, width, height):
    """Return the pictures of a film, (frames, height, width, 3)."""
    ffmpeg = pytest.importorskip("imageio_ffmpeg").get_ffmpeg_exe()
    command = [ffmpeg, "-v", "error", "-i", f"file:{path}", "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    data = subprocess.run(command, capture_output=True, check=True).stdout
    return np.frombuffer(data, np.uint8).reshape(-1, height, width, 3)


def test_a_film_shows_a_recorded_run(tmp_path, monkeypatch):
    pytest.importorskip("imageio_ffmpeg")
    if renderer.render_problem() is not None:
        pytest.skip("needs a Vulkan device")
    monkeypatch.chdir(tmp_path)
    assert main(["rollout", "--num-envs", "2", "--seconds", "0.3", "--workers", "0", "--out", "run.npz"]) == 0
    assert main(["plot", "run.npz", "--film", "film.mp4"]) == 0
    frames = read_film("film.mp4", 960, 540)
    assert frames.shape[1:] == (540, 960, 3)
    assert 8 <= len(frames) <= 10
    assert frames[0].std() > 5  # not empty
    assert np.abs(frames[-1].astype(int) - frames[0]).max() > 40  # the robots move


class Slides:
    """Stand-in for the scene of a film on machines that cannot render: the picture changes with the pose."""

    def __init__(self, *_):
        self._level = 0.0

    def add_camera(self, width, height):
        noise = np.random.default_rng(0).random((height, width, 3))
        return lambda: (255 * np.clip(noise * self._level, 0, 1)).astype(np.uint8)

    def place(self, qpos, base_pose):
        self._level += 0.04


@pytest.fixture
def slides(monkeypatch):
    pytest.importorskip("imageio_ffmpeg")
    monkeypatch.setattr(renderer, "render_problem", lambda: None)
    monkeypatch.setattr(film, "RenderScene", Slides)


@pytest.mark.parametrize("name", ["film.mp4", "-film.mp4", "film.GIF"])
def test_a_film_has_its_pictures_in_order(name, rollout, tmp_path, slides, monkeypatch):
    monkeypatch.chdir(tmp_path)
    film.write_film(rollout, name, width=101, height=51, fps=100)
    frames = read_film(name, 102 if name.endswith("mp4") else 101, 52 if name.endswith("mp4") else 51)
    assert len(frames) == len(film.film_rows(rollout, 100)) == 20
    brightness = frames.mean(axis=(1, 2, 3))
    assert (np.diff(brightness) > 0).all()
    assert os.listdir(tmp_path) == [name]


def test_a_film_that_is_interrupted_leaves_the_older_one(rollout, tmp_path, slides):
    path = tmp_path / "film.mp4"
    path.write_text("older")

    def interrupted(rows):
        yield from rows[:5]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        film.write_film(rollout, path, progress=interrupted)
    assert path.read_text() == "older"
    assert os.listdir(tmp_path) == ["film.mp4"]


def test_the_window_plays_for_the_given_time(rollout):
    if not os.environ.get("DISPLAY") or renderer.render_problem() is not None:
        pytest.skip("needs a display and a Vulkan device")
    film.show_window(rollout, seconds=1.0)


def test_frames_of_a_film_follow_the_recorded_time(rollout):
    assert film.film_rows(rollout, 50.0).tolist() == list(range(0, 20, 2))
    assert film.film_rows(rollout, 200.0)[:5].tolist() == [0, 1, 1, 2, 2]


def test_the_demo_with_a_window_fails_before_it_runs_where_nothing_renders(monkeypatch, capsys):
    monkeypatch.setattr(renderer, "render_problem", lambda: "no device")
    assert main(["demo", "--viewer"]) == 2
    output = capsys.readouterr()
    assert "batchpid view" in output.err
    assert "robots" not in output.out  # viser may print that an earlier test's server has stopped
