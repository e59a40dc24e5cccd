"""Full and read-only disks: every command that writes ends in one line, and the earlier file stays."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from disks import fill, limited_file_size, make_read_only, small_disk
from tiny_urdf import one_joint, write

import batchpid as bp
from batchpid.sim import Recorder, Runner, Snapshot, plots, write_recording
from batchpid.sim.cli import outputs
from batchpid.sim.cli import run as cli_run
from batchpid.sim.tuning import robot_survey as surveying

SHORT = ("--num-envs", "1", "--workers", "0", "--seconds", "0.02")
TUNE = ("tune", "--generations", "1", "--population", "4", "--seconds", "0.05", "--workers", "0")
COMMANDS = {
    "demo": (("demo", *SHORT, "--picture"), "a.png"),
    "rollout npz": (("rollout", *SHORT, "--out"), "a.npz"),
    "rollout h5": (("rollout", *SHORT, "--out"), "a.h5"),
    "rollout picture": (("rollout", *SHORT, "--picture"), "a.svg"),
    "plot": (("plot", "RUN", "--picture"), "a.png"),
    "compare": (("compare", "--moves", "1", "--workers", "0", "--seconds", "0.02", "--picture"), "a.png"),
    "survey json": (("survey", "URDF", "--workers", "1", "--out", "OTHER.md", "--json"), "a.json"),
    "survey": (("survey", "URDF", "--workers", "1", "--json", "OTHER.json", "--out"), "a.md"),
    "tune": ((*TUNE, "--picture", "OTHER.png", "--out"), "a.yaml"),
    "tune picture": ((*TUNE, "--out", "OTHER.yaml", "--picture"), "a.png"),
}
"""Flags of each command that writes, its output last."""
SECOND = ("rollout picture", "survey json", "tune picture")
"""Other outputs of a command that is in the table already."""
ROWS = [pytest.param(name, marks=pytest.mark.slow if name in SECOND else ()) for name in COMMANDS]
NEEDS = {"rollout h5": "h5py", "tune": "cmaes", "tune picture": "cmaes"}


@pytest.fixture(scope="module")
def rollout(panda):
    """A rollout of 4 ticks."""
    with Runner(panda, 1, workers=0, substeps=20) as runner:
        return runner.rollout(np.tile(panda.start, (4, 1, 1)))


@pytest.fixture
def command(batchpid, rollout, tmp_path):
    """Function that runs a command of the table with its output in a folder and returns (exit status, stderr)."""
    run = write_recording(rollout, tmp_path / "run.npz")
    urdf = write(tmp_path, one_joint(), "one_joint.urdf")

    def run_it(name: str, path: Path) -> tuple[int, str]:
        if name in NEEDS:
            pytest.importorskip(NEEDS[name])
        words = {"RUN": run, "URDF": urdf}
        words |= {word: tmp_path / word.lower() for word in COMMANDS[name][0] if word.startswith("OTHER.")}
        status, _, err = batchpid(*(words.get(word, word) for word in COMMANDS[name][0]), path, "--force")
        return status, err

    return run_it


def contents(folder: Path) -> dict[str, bytes | None]:
    """Return the files below ``folder``, and its folders as None."""
    return {str(path): path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


def assert_refused(result: tuple[int, str], folder: Path, before: dict[str, bytes | None]) -> None:
    status, err = result
    assert (status, err.count("\n")) == (2, 1), err
    assert err.startswith("batchpid: ")
    assert contents(folder) == before


@pytest.mark.quick_rows(3)
@pytest.mark.parametrize("name", ROWS)
def test_places_that_cannot_be_written_to_are_refused_before_the_run(name, command, tmp_path, monkeypatch):
    path = tmp_path / "place" / COMMANDS[name][1]
    path.parent.mkdir()
    path.mkdir()
    (tmp_path / "file").write_text("kept")
    (device := tmp_path / f"device{path.suffix}").symlink_to("/dev/full")
    long = tmp_path / ("long" * 75 + path.suffix)
    before = contents(tmp_path)
    for place in (path, tmp_path / "file" / path.name, device, long, "/dev/null/" + path.name, "/proc/" + path.name):
        assert_refused(command(name, place), tmp_path, before)
    with limited_file_size(1000):
        assert_refused(command(name, tmp_path / "new" / path.name), tmp_path, before)


@pytest.mark.quick_rows(6)
@pytest.mark.parametrize("name", ROWS)
@pytest.mark.parametrize("make", [fill, make_read_only], ids=["full", "read-only"])
def test_disks_that_cannot_be_written_to_are_refused_before_the_run(make, name, command, tmp_path):
    with small_disk(tmp_path / "disk", 1 << 16) as disk:
        (path := disk / COMMANDS[name][1]).write_text("older")
        make(disk)
        before = contents(disk)
        for place in (path, disk / "new" / "folder" / path.name):
            assert_refused(command(name, place), disk, before)


@pytest.mark.parametrize("name", COMMANDS)
def test_files_and_folders_without_permission_are_refused_before_the_run(name, command, tmp_path):
    (folder := tmp_path / "place").mkdir()
    (path := folder / COMMANDS[name][1]).write_text("older")
    path.chmod(0o400)
    if os.access(path, os.W_OK):
        pytest.skip("this process may write everywhere, as root may with all its capabilities")
    path.chmod(0o600)
    for place, mode, back in ((path, 0o400, 0o600), (folder, 0o500, 0o700)):
        before = contents(folder)
        place.chmod(mode)
        assert_refused(command(name, path), folder, before)
        place.chmod(back)


def run_while_filling(command, name: str, disk: Path, free: int, monkeypatch) -> int:
    """Run a command on a disk on which ``free`` bytes are left after the trial, and return its exit status."""
    (path := disk / COMMANDS[name][1]).write_text("older")

    try_writing = outputs.try_writing

    def try_and_fill(place):
        try_writing(place)
        if Path(place) == path and not (disk / "filler").exists():
            fill(disk)
            os.truncate(disk / "filler", max(0, (disk / "filler").stat().st_size - free))

    with monkeypatch.context() as patched:
        patched.setattr("batchpid.sim.cli.outputs.try_writing", try_and_fill)
        status, err = command(name, path)
    if status:
        assert (status, err.count("\n")) == (2, 1), err
        assert any(text in err for text in ("No space left", "ffmpeg")), err
        assert path.read_text() == "older"
    else:
        assert path.read_bytes() != b"older"
    left = {each.name for each in disk.iterdir()} - {path.name, "filler"}
    assert left <= ({"a.h5.partial"} if name.endswith("h5") else set())
    return status


@pytest.mark.parametrize("name", ["rollout npz", "rollout h5", pytest.param("plot", marks=pytest.mark.slow)])
def test_a_disk_that_fills_up_during_the_run_keeps_the_older_file(name, command, tmp_path, monkeypatch):
    with small_disk(tmp_path / "disk", 1 << 16) as disk:
        assert run_while_filling(command, name, disk, 0, monkeypatch) == 2


@pytest.fixture
def simulated_once(monkeypatch):
    """Long simulations of the commands give their first result in every later run too."""

    def once(function):
        results = []

        def remember(*arguments, **options):
            if not results:
                result = function(*arguments, **options)
                results.append(list(result) if isinstance(result, Iterator) else result)
            return results[0]

        return remember

    for module, name in ((cli_run, "evaluate_sets"), (surveying, "survey")):
        monkeypatch.setattr(module, name, once(getattr(module, name)))


@pytest.mark.slow
@pytest.mark.usefixtures("simulated_once")
@pytest.mark.parametrize("name", COMMANDS)
def test_a_disk_with_any_space_left_keeps_the_older_file_or_holds_the_new_one(name, command, tmp_path, monkeypatch):
    statuses = set()
    for free in (*range(0, 9 * 4096, 2 * 4096), *np.geomspace(65536, 12e6, 4).astype(int)):
        with small_disk(tmp_path / "disk", 1 << 24) as disk:
            statuses.add(run_while_filling(command, name, disk, int(free), monkeypatch))
    assert statuses == {0, 2}


WRITERS: dict[str, tuple[str, Callable]] = {
    "params": ("a.yaml", lambda runner, rollout, path: bp.save_params(path, runner.params, runner.robot.joint_names)),
    "snapshot": ("a.npz", lambda runner, rollout, path: runner.snapshot().save(path)),
    "recording": ("a.npz", lambda runner, rollout, path: write_recording(rollout, path, overwrite=True)),
    "HDF5": ("a.h5", lambda runner, rollout, path: write_recording(rollout, path, overwrite=True)),
    "recorder": ("a.h5", lambda runner, rollout, path: Recorder(path, runner, overwrite=True).close()),
    "picture": ("a.png", lambda runner, rollout, path: plots.save(plots.efforts(rollout), path)),
    "drawing": ("a.svg", lambda runner, rollout, path: plots.save(plots.efforts(rollout), path)),
}


@pytest.mark.parametrize(
    "name",
    [*list(WRITERS)[:-2], *(pytest.param(each, marks=pytest.mark.slow) for each in ("picture", "drawing"))],
)
@pytest.mark.parametrize("make", [fill, make_read_only], ids=["full", "read-only"])
def test_a_call_that_cannot_write_raises_an_error_of_the_system(make, name, panda, rollout, tmp_path):
    if name in ("HDF5", "recorder"):
        pytest.importorskip("h5py")
    file, write = WRITERS[name]
    with Runner(panda, 1, workers=0) as runner, small_disk(tmp_path / "disk", 1 << 16) as disk:
        (path := disk / file).write_text("older")
        make(disk)
        before = contents(disk)
        with pytest.raises(OSError, match=r"No space left|Read-only"):
            write(runner, rollout, path)
        assert contents(disk) == before
        assert runner.recorder is None
        assert isinstance(runner.snapshot(), Snapshot)
