"""A recorder streams every tick to a file that any reader of HDF5 reads, even after a kill."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
from identical import assert_identical
from robots import load_bundled

import batchpid as bp
from batchpid.errors import ClosedError, InvalidArgumentError
from batchpid.sim import Recorder, RecordingError, Runner, read_recording
from batchpid.sim.cli import main
from batchpid.sim.recording import recorder as recorder_module
from batchpid.sim.robot.robot_options import content
from batchpid.sim.rollout import ACTUATORS, PARAMS, RESET, RESTORE

ROBOT = load_bundled("panda")
N = 3


def make(**options):
    return Runner(ROBOT, N, **({"params": ROBOT.params(), "workers": 0, "substeps": 2} | options))


def table(ticks):
    noise = np.random.default_rng(ticks).uniform(-0.3, 0.3, (ticks, N, ROBOT.dof))
    return np.clip(ROBOT.settings.target + noise, ROBOT.lower, ROBOT.upper)


def test_every_tick_is_recorded_with_its_units(tmp_path):
    path = tmp_path / "deep" / "run.h5"
    with make() as runner:
        start = runner.step(ROBOT.start).qpos
        with Recorder(path, runner):
            rollout = runner.rollout(table(40))
        runner.step(ROBOT.start)
    recording = read_recording(path)
    assert_identical(recording, rollout)
    assert recording.feedforward is None
    assert recording.info.digest == content(ROBOT)
    np.testing.assert_array_equal(recording.info.start, start)
    assert {"python", "numpy", "h5py", "sapien"} <= set(recording.info.versions)
    assert [path.name] == os.listdir(path.parent)
    with h5py.File(path) as file:  # as any reader of HDF5 sees it
        assert file.attrs["num_envs"] == N
        assert file["qpos"].attrs["unit"].tolist() == ["rad"] * 7 + ["m"] * 2
        assert file["qvel"].attrs["unit"][0] == "rad/s"
        assert file["effort"].attrs["unit"].tolist() == ["N m"] * 7 + ["N"] * 2
        assert file["time"].attrs["unit"].tolist() == ["s"]


def test_the_start_is_that_of_the_reset_before_the_first_tick(tmp_path):
    with make() as runner, Recorder(tmp_path / "run.h5", runner):
        start = runner.reset(table(1)[0]).qpos
        runner.step(ROBOT.start)
    np.testing.assert_array_equal(read_recording(tmp_path / "run.h5").info.start, start)


def reset(runner):
    runner.reset(table(1)[0], mask=[True, False, True])


def restore(runner):
    runner.restore(runner.snapshot())


def set_params(runner):
    runner.params = ROBOT.params(kp=5.0)


def set_actuators(runner):
    runner.actuators = bp.make_actuators(ROBOT.dof, strength=0.5)


CHANGES = {
    reset: [RESET, 0, RESET],
    restore: [RESTORE] * N,
    set_params: [PARAMS] * N,
    set_actuators: [ACTUATORS] * N,
}
"""Every method that changes the state of a runner, and what its recording says of each env."""


def test_every_change_of_the_state_is_recorded_before_its_tick(tmp_path):
    path = tmp_path / "run.h5"
    expected = []
    with make() as runner:
        runner.step(ROBOT.start)
        with Recorder(path, runner):
            for change, codes in CHANGES.items():
                runner.rollout(table(2))
                change(runner)
                runner.step(ROBOT.start)
                expected += [[0] * N, [0] * N, codes]
            assert runner.rollout(table(1)).changes is None
            # Several changes at once.
            for change in CHANGES:
                change(runner)
            expected += [[0] * N, list(map(sum, zip(*CHANGES.values(), strict=True)))]
            assert runner.rollout(table(1)).changes.tolist() == expected[-1:]
    recorded = read_recording(path)
    np.testing.assert_array_equal(recorded.changes, expected)


def test_feedforwards_are_recorded_where_they_are_given(tmp_path):
    efforts = np.random.default_rng(0).uniform(-1, 1, (4, N, ROBOT.dof))
    with make() as runner, Recorder(tmp_path / "run.h5", runner):
        runner.step(ROBOT.start)
        rollout = runner.rollout(table(4), feedforwards=efforts)
    np.testing.assert_array_equal(rollout.feedforward, efforts)
    np.testing.assert_array_equal(
        read_recording(tmp_path / "run.h5").feedforward, [0 * efforts[0], *efforts]
    )


def test_ticks_of_another_length_are_refused_while_it_records(tmp_path):
    with make() as runner:
        with Recorder(tmp_path / "run.h5", runner):
            runner.step(ROBOT.start, substeps=2)
            with pytest.raises(InvalidArgumentError, match="substeps: is not the runner's 2"):
                runner.step(ROBOT.start, substeps=20)
        runner.step(ROBOT.start, substeps=20)
    np.testing.assert_allclose(read_recording(tmp_path / "run.h5").time, [0.001])


def test_a_growing_recording_can_be_read(tmp_path, monkeypatch):
    monkeypatch.setattr(recorder_module, "WRITE_PERIOD", 0.0)
    with make() as runner, Recorder(tmp_path / "run.h5", runner):
        rollout = runner.rollout(table(5))
        growing = read_recording(tmp_path / "run.h5")
        assert_identical(growing, rollout)
        assert not growing.info.complete


def test_an_existing_file_is_replaced_only_when_asked(tmp_path):
    path = tmp_path / "run.h5"
    path.write_text("precious")
    with make() as runner:
        with pytest.raises(InvalidArgumentError, match=r"exists already.*run\.h5.*overwrite=True"):
            Recorder(path, runner)
        recorder = Recorder(path, runner, overwrite=True)
        assert path.read_text() == "precious"
        with make() as other:
            late = Recorder(tmp_path / "late.h5", other)
            (tmp_path / "late.h5").write_text("since then")
            other.step(ROBOT.start)
            with pytest.raises(RecordingError, match="pass overwrite=True"):
                late.close()
        runner.step(ROBOT.start)
        recorder.close()
        recorder.close()
    assert read_recording(path).info.complete


def test_an_exception_leaves_an_incomplete_recording(tmp_path):
    path = tmp_path / "run.h5"
    with make() as runner, pytest.raises(ZeroDivisionError), Recorder(path, runner):  # noqa: PT012
        rollout = runner.rollout(table(4))
        raise ZeroDivisionError
    recording = read_recording(path)
    assert_identical(recording, rollout)
    assert not recording.info.complete


def test_a_runner_takes_one_recorder_at_a_time_and_none_when_closed(tmp_path):
    with make() as runner:
        with Recorder(tmp_path / "a.h5", runner):
            runner.step(ROBOT.start)
            with pytest.raises(
                InvalidArgumentError, match=r"runner: is being recorded already, to .*a\.h5.*close"
            ):
                Recorder(tmp_path / "b.h5", runner)
            runner.step(ROBOT.start)
        with Recorder(tmp_path / "b.h5", runner):
            runner.step(ROBOT.start)
    with pytest.raises(ClosedError):
        Recorder(tmp_path / "c.h5", runner)
    assert sorted(os.listdir(tmp_path)) == ["a.h5", "b.h5"]
    assert [len(read_recording(tmp_path / name).time) for name in ("a.h5", "b.h5")] == [2, 1]


def with_path():
    """Return the environment of a program that imports what this one does."""
    return os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, [str(Path.cwd()), *sys.path]))}


FULL = """
import os, pytest, resource, sys
from batchpid.sim import Recorder, RecordingError, Robot, Runner
from batchpid.sim.recording import recorder
recorder.WRITE_PERIOD = 0.0
robot = Robot.load("panda")
with Runner(robot, 3, params=robot.params(), workers=0, substeps=2) as runner:
    recorder = Recorder(sys.argv[1], runner)
    runner.step(robot.start)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1, 1))  # as on a full disk
    runner.step(robot.start)
    with pytest.raises(RecordingError, match=r"run[.]h5: cannot be written: .*File too large"):
        runner.step(robot.start)
    with pytest.raises(RecordingError):
        recorder.close()
    assert runner.step(robot.start).ok.all()

"""


def test_a_file_that_cannot_be_written_is_an_error_before_the_next_tick(tmp_path):
    command = [sys.executable, "-c", FULL, tmp_path / "run.h5"]
    subprocess.run(command, env=with_path(), timeout=120, check=True)


PROGRAM = """
import sys, time, numpy as np, warnings
warnings.simplefilter("ignore")
from batchpid.sim import Robot, Runner, Recorder
robot = Robot.load("panda")
with (
    Runner(robot, 3, params=robot.params(), workers=0, substeps=2) as runner,
    Recorder(sys.argv[1], runner) as recorder,
):
    for tick in range(10**9):
        runner.step(np.clip(robot.settings.target * np.sin(tick / 50), robot.lower, robot.upper))
        print(time.monotonic(), flush=True)
"""


def kill_after(seconds, path):
    """Kill a recorded program some seconds after its first tick; return when each of its ticks
    ended [s].
    """
    command = [sys.executable, "-c", PROGRAM, path]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=with_path()) as process:
        lines = [process.stdout.readline()]
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            lines.append(process.stdout.readline())
        process.send_signal(signal.SIGKILL)
        lines += process.stdout.read().splitlines()
    return np.array([line for line in lines if line.endswith("\n")] or [np.nan], float)


@pytest.mark.quick_rows(1)
@pytest.mark.parametrize("number", range(10))
def test_a_kill_loses_at_most_a_second(number, tmp_path):
    path = str(tmp_path / "run.h5")
    ticks = kill_after(0.8 + np.random.default_rng(number).uniform(0.0, 1.2), path)
    recording = read_recording(path)
    count = len(recording.time)
    assert not recording.info.complete
    longest = np.diff(ticks).max(initial=0.0)  # on a busy machine a tick takes as long as it likes
    assert ticks[-1] - ticks[min(count, len(ticks)) - 1] < 1 + longest
    np.testing.assert_allclose(recording.time, (1 + np.arange(count)) * 2 / 2000)
    assert np.isfinite(recording.qpos).all()
    with h5py.File(path, "r") as file:
        assert file["qpos"].shape[0] >= file["time"].shape[0] >= count
        np.testing.assert_array_equal(file["qpos"][:count], recording.qpos)


@pytest.mark.parametrize("words", [["plot"], ["view", "--play"]])
def test_commands_refuse_an_empty_recording(words, tmp_path, capsys):
    with make() as runner, Recorder(tmp_path / "empty.h5", runner):
        pass
    assert main([*words, str(tmp_path / "empty.h5")]) == 2
    assert "holds no tick" in capsys.readouterr().err
