"""A recorder streams every tick to a file that survives kills and full disks, and destroys no earlier file."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from disks import limited_file_size, small_disk
from identical import assert_identical
from robots import load_bundled

h5py = pytest.importorskip("h5py")

from batchpid.errors import ClosedError, InvalidArgumentError  # noqa: E402
from batchpid.sim import FaultWarning, Recorder, RecordingError, Runner, read_recording, write_recording  # noqa: E402
from batchpid.sim.cli import main  # noqa: E402
from batchpid.sim.recording import partial_file  # noqa: E402
from batchpid.sim.recording import recorder as recorder_module  # noqa: E402
from batchpid.sim.recording import recording_files as files  # noqa: E402

ROBOT = load_bundled("panda")
N = 3


def make(**options):
    return Runner(ROBOT, N, **({"params": ROBOT.params(), "workers": 0, "substeps": 2} | options))


def table(ticks):
    noise = np.random.default_rng(ticks).uniform(-0.3, 0.3, (ticks, N, ROBOT.dof))
    return np.clip(ROBOT.settings.target + noise, ROBOT.lower, ROBOT.upper)


def test_every_tick_is_recorded_with_robot_options_and_units(tmp_path):
    path = tmp_path / "deep" / "run.h5"
    with make() as runner:
        start = runner.step(ROBOT.start).qpos
        with Recorder(path, runner, seed=7) as recorder:
            assert recorder.partial.exists()
            assert not path.exists()
            rollout = runner.rollout(table(40))
        runner.step(ROBOT.start)
    recording = read_recording(path)
    assert_identical(recording, rollout)
    info = recording.info
    assert (info.complete, info.seed, info.control, info.timestep) == (True, 7, "pid", 1 / 2000)
    assert recording.tick == rollout.tick
    assert (info.robot, info.joint_names, info.urdf) == ("panda", ROBOT.joint_names, ROBOT.urdf)
    for ours, theirs in zip(info.params, rollout.info.params, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    np.testing.assert_array_equal(info.start, start)
    assert {"python", "numpy", "h5py", "sapien"} <= set(info.versions)
    assert [path.name] == os.listdir(path.parent)
    with h5py.File(path) as file:  # as any reader of HDF5 sees it
        assert file.attrs["num_envs"] == N
        assert file["qpos"].attrs["unit"].tolist() == ["rad"] * 7 + ["m"] * 2
        assert file["qvel"].attrs["unit"][0] == "rad/s"
        assert file["effort"].attrs["unit"].tolist() == ["N m"] * 7 + ["N"] * 2
        assert file["time"].attrs["unit"].tolist() == ["s"]


def test_setpoints_under_control_by_effort_are_in_newton_metres(tmp_path):
    with make(control="effort") as runner, Recorder(tmp_path / "run.h5", runner):
        runner.step(np.zeros(9))
    with h5py.File(tmp_path / "run.h5") as file:
        assert file["setpoint"].attrs["unit"][0] == "N m"


@pytest.mark.slow
def test_a_growing_recording_can_be_read(tmp_path):
    with make() as runner, Recorder(tmp_path / "run.h5", runner) as recorder:
        rollout = runner.rollout(table(5))
        deadline = time.monotonic() + 10
        while len(read_recording(recorder.partial).time) < 5:
            assert time.monotonic() < deadline
            time.sleep(0.05)
        assert_identical(read_recording(recorder.partial), rollout)
        assert not read_recording(recorder.partial).info.complete


def test_an_open_reader_does_not_block_completion(tmp_path):
    watch = (
        "import h5py, sys; file = h5py.File(sys.argv[1], 'r', swmr=True, libver='latest'); "
        "print('open', flush=True); sys.stdin.read()"
    )
    with make() as runner, Recorder(tmp_path / "run.h5", runner) as recorder:
        runner.rollout(table(5))
        command = [sys.executable, "-c", watch, recorder.partial]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
            assert process.stdout.readline() == b"open\n"
            recorder.close()
            process.stdin.close()
    assert len(read_recording(tmp_path / "run.h5").time) == 5


def test_an_existing_file_is_replaced_only_by_a_complete_recording(tmp_path):
    path = tmp_path / "run.h5"
    path.write_text("precious")
    left = tmp_path / "run.h5.partial"
    left.write_text("precious too")
    with make() as runner:
        with pytest.raises(InvalidArgumentError, match=r"exists already.*run\.h5.*overwrite=True"):
            Recorder(path, runner)
        recorder = Recorder(path, runner, overwrite=True)
        runner.step(ROBOT.start)
        assert path.read_text() == "precious"
        recorder.close()
        recorder.close()
    assert read_recording(path).info.complete
    assert left.read_text() == "precious too"


def test_an_exception_leaves_an_incomplete_recording(tmp_path):
    path = tmp_path / "run.h5"
    with make() as runner, pytest.raises(ZeroDivisionError), Recorder(path, runner):  # noqa: PT012
        rollout = runner.rollout(table(4))
        raise ZeroDivisionError
    recording = read_recording(path)
    assert_identical(recording, rollout)
    assert not recording.info.complete
    kept = path.read_bytes()
    with make() as runner, pytest.raises(ZeroDivisionError), Recorder(path, runner, overwrite=True):  # noqa: PT012
        runner.rollout(table(2))
        raise ZeroDivisionError
    assert path.read_bytes() == kept
    assert len(read_recording(tmp_path / "run.h5.partial").time) == 2


def test_a_runner_takes_one_recorder_at_a_time_and_none_when_closed(tmp_path):
    with make() as runner:
        with Recorder(tmp_path / "a.h5", runner):
            runner.step(ROBOT.start)
            with pytest.raises(InvalidArgumentError, match=r"runner: is being recorded already, to .*a\.h5.*close"):
                Recorder(tmp_path / "b.h5", runner)
            runner.step(ROBOT.start)
        with Recorder(tmp_path / "b.h5", runner):
            runner.step(ROBOT.start)
    with pytest.raises(ClosedError):
        Recorder(tmp_path / "c.h5", runner)
    assert sorted(os.listdir(tmp_path)) == ["a.h5", "b.h5"]
    assert [len(read_recording(tmp_path / name).time) for name in ("a.h5", "b.h5")] == [2, 1]


def test_a_file_that_another_program_made_meanwhile_is_kept(tmp_path):
    path = tmp_path / "run.h5"
    with make() as runner:
        recorder = Recorder(path, runner)
        runner.step(ROBOT.start)
        path.write_text("theirs")
        with pytest.raises(RecordingError, match=r"made by another program.*run\.h5\.partial"):
            recorder.close()
    assert path.read_text() == "theirs"
    assert len(read_recording(tmp_path / "run.h5.partial").time) == 1


def test_faults_are_recorded(tmp_path):
    with make(on_invalid_input="contain") as runner, Recorder(tmp_path / "run.h5", runner):
        setpoints = table(4)
        setpoints[2, 1, 3] = np.nan
        with pytest.warns(FaultWarning):
            runner.rollout(setpoints)
    recording = read_recording(tmp_path / "run.h5")
    (fault,) = recording.info.faults
    assert (fault.env, fault.joint, fault.cause) == (1, "panda_joint4", "setpoint")
    assert recording.ok.tolist() == [[True] * 3] * 2 + [[True, False, True]] * 2


FULL = """
import os, sys, time, warnings
warnings.simplefilter("ignore")
from batchpid.sim import Robot, Runner, Recorder, read_recording
robot = Robot.load("panda")
with Runner(robot, 3, params=robot.params(), workers=0, substeps=2) as runner:
    recorder = Recorder(sys.argv[1], runner)
    for _ in range(50):
        runner.step(robot.start)
    while len(read_recording(recorder.partial).time) < 50:
        time.sleep(0.02)
    for name in os.listdir("/proc/self/fd"):
        if os.path.realpath(f"/proc/self/fd/{name}") == os.path.realpath(recorder.partial):
            os.dup2(os.open("/dev/full", os.O_RDWR), int(name))  # from here on there is no space
    try:
        while True:
            runner.step(robot.start)
    except OSError as error:
        print(error)
    try:
        recorder.close()
    except OSError as error:
        print(error)
    print(runner.step(robot.start).ok.all())
"""


@pytest.mark.slow
def test_a_full_disk_raises_and_what_was_recorded_can_be_read(tmp_path):
    path = tmp_path / "run.h5"
    done = subprocess.run(
        [sys.executable, "-c", FULL, path],
        capture_output=True,
        text=True,
        timeout=120,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, [str(Path.cwd()), *sys.path]))},
    )
    assert (done.returncode, done.stderr) == (0, "")
    message = f"{path}.partial: cannot be written: No space left on device; what was recorded before can be read"
    assert done.stdout.splitlines() == [message, message, "True"]
    assert len(read_recording(tmp_path / "run.h5.partial").time) == 50


def test_a_file_that_cannot_be_made_leaves_none(tmp_path, monkeypatch):
    with make() as runner:

        def full(self, *arguments, **options):
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(h5py.Group, "create_dataset", full)
        with pytest.raises(RecordingError, match=r"partial: cannot be made: .*No space"):
            Recorder(tmp_path / "run.h5", runner)
        assert not os.listdir(tmp_path)
        assert runner.recorder is None


def limited_disk(folder, kind, size):
    """Make ``folder`` a disk of ``size`` bytes, or let this process write files of that size at most."""
    return small_disk(folder, size) if kind == "disk" else limited_file_size(size)


@pytest.mark.parametrize("kind", ["disk", pytest.param("file size", marks=pytest.mark.slow)])
def test_a_nearly_full_disk_raises_and_what_was_recorded_can_be_read(kind, tmp_path, monkeypatch):
    monkeypatch.setattr(files, "CHUNK_BYTES", 2048)
    monkeypatch.setattr(partial_file, "METADATA_BYTES", 1 << 15)
    ticks, outcomes = 40, set()
    for size in (4096, 28_672, *range(53_248, 260_000, 49_152)):
        folder = tmp_path / str(size)
        folder.mkdir()
        path, rollouts, message = folder / "run.h5", [], ""
        with make() as runner, limited_disk(folder, kind, size):
            try:
                with Recorder(path, runner):
                    rollouts.append(runner.rollout(table(ticks)))
            except RecordingError as error:
                message = str(error)
                assert "No space left" in message or "File too large" in message
            outcomes.add(message.partition(": ")[2].partition(":")[0])
            found = os.listdir(folder)
            if "cannot be made" in message:
                assert found == []
                continue
            recording = read_recording(folder / found[0])
            count = len(recording.time)
            assert_identical(recording, rollouts[0].for_ticks(slice(0, count)))
            assert count == ticks or "cannot be written" in message
            assert found == ["run.h5.partial" if message else "run.h5"]
    assert outcomes >= {"", "cannot be made", "cannot be written"}


@pytest.mark.parametrize("suffix", [".npz", ".h5"])
@pytest.mark.parametrize("kind", ["disk", "file size"])
def test_a_rollout_that_does_not_fit_leaves_the_older_file(kind, suffix, tmp_path):
    with make() as runner:
        rollout = runner.rollout(table(200))
    for size in range(16384, 300_000, 65_536):
        with limited_disk(tmp_path, kind, size):
            path = tmp_path / f"run{suffix}"
            path.write_text("older")
            try:
                write_recording(rollout, path, overwrite=True)
                assert_identical(read_recording(path), rollout)
            except RecordingError as error:
                assert "No space left" in str(error) or "File too large" in str(error)  # noqa: PT017
                assert path.read_text() == "older"
            assert os.listdir(tmp_path) == [path.name]
            path.unlink()


def test_bad_paths_are_refused():
    with make() as runner:
        for path in ("run.csv", "run.npz", "run", 3, None):
            with pytest.raises(InvalidArgumentError, match="path"):
                Recorder(path, runner)


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
        begun = time.monotonic()
        runner.step(np.clip(robot.settings.target * np.sin(tick / 50), robot.lower, robot.upper))
        print(begun, time.monotonic(), flush=True)
        if tick == int(sys.argv[2]):
            print("pause", flush=True)
            time.sleep(100)
"""


def kill_after(seconds, path, number=signal.SIGKILL, pause=-1):
    """Send ``number`` to a recorded program after ``seconds``, or in its pause after ``pause`` ticks.

    Return when each of its ticks began and ended (ticks, 2) [s].
    """
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, [str(Path.cwd()), *sys.path]))}
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, path, str(pause)], stdout=subprocess.PIPE, text=True, env=environment
    )
    lines = [process.stdout.readline()]
    end = time.monotonic() + seconds
    while time.monotonic() < end and lines[-1] != "pause\n":
        lines.append(process.stdout.readline())
    while lines[-1] == "pause\n" and time.monotonic() < end and read_count(path + ".partial") < len(lines) - 1:
        time.sleep(0.1)
    process.send_signal(number)
    lines += process.stdout.read().splitlines()
    process.stdout.close()
    process.wait()
    return np.array([line.split() for line in lines if len(line.split()) == 2], float)


def read_count(path):
    try:
        return len(read_recording(path).time)
    except RecordingError:  # no recording yet
        return 0


def assert_at_most_a_second_is_lost(recording, ticks):
    kept = len(recording.time)
    assert kept <= len(ticks) + 1
    if kept < len(ticks):
        assert ticks[-1, 0] - ticks[kept, 1] < 1
    assert np.isfinite(recording.qpos).all()
    np.testing.assert_allclose(recording.time, (1 + np.arange(kept)) * 2 / 2000)


@pytest.mark.parametrize(
    "number",
    [signal.SIGKILL, *(pytest.param(each, marks=pytest.mark.slow) for each in (signal.SIGTERM, signal.SIGINT))],
)
def test_a_kill_loses_at_most_a_second(number, tmp_path):
    ticks = kill_after(1.7, str(tmp_path / "run.h5"), number)
    recording = read_recording(tmp_path / ("run.h5" if number == signal.SIGINT else "run.h5.partial"))
    assert_at_most_a_second_is_lost(recording, ticks)
    assert len(ticks) > 10
    assert not recording.info.complete


@pytest.mark.slow
def test_a_kill_in_a_pause_loses_nothing(tmp_path):
    assert len(kill_after(60, str(tmp_path / "run.h5"), pause=20)) == 21
    assert len(read_recording(tmp_path / "run.h5.partial").time) == 21


@pytest.mark.slow
def test_a_kill_at_any_moment_loses_at_most_a_second(tmp_path):
    chance = np.random.default_rng(0)
    for case in range(20):
        ticks = kill_after(chance.uniform(0.0, 1.5), str(tmp_path / f"run{case}.h5"))
        assert_at_most_a_second_is_lost(read_recording(tmp_path / f"run{case}.h5.partial"), ticks)


@pytest.mark.slow
def test_ticks_wait_for_a_slow_disk(tmp_path, monkeypatch):
    monkeypatch.setattr(recorder_module, "WRITE_PERIOD", 0.05)
    monkeypatch.setattr(recorder_module, "MAX_LAG", 0.2)
    disk, flush, ticks, most = threading.Event(), h5py.Dataset.flush, [], 1_000_000

    def flush_when_the_disk_is_ready(self):
        disk.wait()
        flush(self)

    monkeypatch.setattr(h5py.Dataset, "flush", flush_when_the_disk_is_ready)

    def run(runner):
        while len(ticks) < most and not disk.is_set():
            ticks.append(runner.step(ROBOT.start))

    with make() as runner, Recorder(tmp_path / "run.h5", runner):
        thread = threading.Thread(target=run, args=(runner,))
        thread.start()
        before = -1
        while before != len(ticks) or not ticks:  # until no tick ended for a while
            before = len(ticks)
            time.sleep(0.5)
        disk.set()
        thread.join()
    assert len(ticks) < most
    assert len(read_recording(tmp_path / "run.h5").time) == len(ticks)


@pytest.mark.slow
def test_plot_draws_what_a_kill_left_and_refuses_an_empty_recording(tmp_path, capsys):
    with make() as runner, Recorder(tmp_path / "killed.h5", runner) as recorder:
        runner.rollout(table(20))
        while read_count(recorder.partial) < 20:
            time.sleep(0.02)
        shutil.copy(recorder.partial, tmp_path / "c.h5.partial")  # as a kill would leave it
    words = ["--kind", "efforts", "--every", "3", "--joints", "panda_joint1"]
    assert main(["plot", str(tmp_path / "c.h5.partial"), *words]) == 0
    assert (tmp_path / "c-efforts.png").exists()
    assert "cut short" in capsys.readouterr().out
    with make() as runner, Recorder(tmp_path / "empty.h5", runner):
        pass
    assert main(["plot", str(tmp_path / "empty.h5")]) == 2
    assert "holds no tick" in capsys.readouterr().err
