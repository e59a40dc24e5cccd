"""Rollouts are read from files as they were written, and damaged files are refused with their names."""

from __future__ import annotations

import json
import os
import resource
import shutil
import sys
import zipfile
from dataclasses import fields, replace

import numpy as np
import pytest
from identical import assert_identical

from batchpid.errors import BatchPIDError, InvalidArgumentError
from batchpid.sim import FaultWarning, RecordingError, Rollout, RunInfo, Runner, read_recording, write_recording
from batchpid.sim.recording import hdf5

SUFFIXES = (".npz", ".h5")


def skip_without_h5py(suffix):
    if suffix != ".npz":
        pytest.importorskip("h5py")


@pytest.fixture(scope="module")
def rollout(panda):
    """A rollout of 6 ticks in which env 1 of 3 fails; every env has another kp."""
    params = panda.params(kp=np.linspace(30.0, 50.0, 3)[:, None])
    setpoints = np.tile(panda.settings.target, (6, 3, 1))
    setpoints[4, 1, 3] = np.nan
    options = {"substeps": 2, "params": params, "physics": "fast", "on_invalid_input": "contain"}
    with Runner(panda, 3, workers=0, **options) as runner:
        runner.step(panda.start)
        with pytest.warns(FaultWarning):
            return runner.rollout(setpoints)


def assert_same_info(first, second):
    for field in fields(RunInfo):
        ours, theirs = getattr(first, field.name), getattr(second, field.name)
        if field.name == "description":
            assert ours is None
            continue
        if field.name == "params" and theirs is not None:
            assert all(np.array_equal(one, other) for one, other in zip(ours, theirs, strict=True))
        elif isinstance(theirs, np.ndarray):
            np.testing.assert_array_equal(ours, theirs, strict=True)
        else:
            assert ours == theirs, field.name


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_rollouts_are_read_as_they_were_written(suffix, tmp_path, rollout):
    skip_without_h5py(suffix)
    path = tmp_path / "new" / f"run{suffix}"
    assert write_recording(rollout, path, seed=7) == path
    read = read_recording(path)
    assert_identical(read, rollout)
    assert read.tick == rollout.tick == 0.001
    assert_same_info(read.info, replace(rollout.info, seed=7))
    (fault,) = read.info.faults
    assert (fault.env, fault.joint, fault.cause) == (1, "panda_joint4", "setpoint")
    assert (read.info.physics, read.info.compensate, read.info.complete) == ("fast", "gravity+coriolis+friction", True)
    assert os.listdir(path.parent) == [path.name]
    every = read_recording(path, every=4)
    assert_identical(every, rollout.for_ticks(slice(None, None, 4)))
    assert every.tick == 0.004


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_rollouts_made_by_hand_and_empty_ones_can_be_written(suffix, tmp_path, rollout, panda):
    skip_without_h5py(suffix)
    bare = replace(rollout, info=panda.run_info()).for_ticks(slice(0, 0))
    read = read_recording(write_recording(bare, tmp_path / f"run{suffix}"))
    assert_identical(read, bare)
    assert_same_info(read.info, bare.info)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_existing_files_are_replaced_only_when_asked(suffix, tmp_path, rollout):
    skip_without_h5py(suffix)
    path = tmp_path / f"run{suffix}"
    path.write_text("precious")
    with pytest.raises(InvalidArgumentError, match=rf"exists already.*run\{suffix}.*overwrite=True"):
        write_recording(rollout, path)
    assert path.read_text() == "precious"
    write_recording(rollout, path, overwrite=True)
    assert_identical(read_recording(path), rollout)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_file_that_appears_during_the_write_is_kept(suffix, tmp_path, rollout, monkeypatch):
    """Another program makes it after the look at the folder, while the arrays are compressed."""
    skip_without_h5py(suffix)
    path, arrays = tmp_path / f"run{suffix}", Rollout.arrays

    def late(self):
        path.write_text("theirs")
        return arrays(self)

    monkeypatch.setattr(Rollout, "arrays", late)
    with pytest.raises(RecordingError, match=rf"run\{suffix}: was made by another program"):
        write_recording(rollout, path)
    assert path.read_text() == "theirs"
    assert os.listdir(tmp_path) == [path.name]
    write_recording(rollout, path, overwrite=True)
    monkeypatch.undo()
    assert_identical(read_recording(path), rollout)


def test_a_failed_write_leaves_the_older_file(tmp_path, rollout, monkeypatch):
    path = write_recording(rollout, tmp_path / "run.npz")
    kept = path.read_bytes()

    def full(file, **tables):
        file.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", full)
    with pytest.raises(RecordingError, match=r"run\.npz: cannot be written: .*No space"):
        write_recording(rollout, path, overwrite=True)
    assert path.read_bytes() == kept
    assert os.listdir(tmp_path) == ["run.npz"]


def test_npz_files_of_earlier_versions_are_read(tmp_path, rollout, panda):
    about = {name: getattr(panda, name) for name in ("joint_names", "units", "lower", "upper", "effort_limit")}
    start = np.tile(panda.start, (3, 1))
    np.savez(tmp_path / "run.npz", **rollout.arrays(), tick=rollout.tick, start=start, robot="panda", **about)
    read = read_recording(tmp_path / "run.npz")
    assert_identical(read, rollout)
    assert (read.info.robot, read.info.joint_names, read.info.units) == ("panda", panda.joint_names, panda.units)
    assert (read.tick, read.info.timestep, read.info.params) == (0.001, None, None)
    np.testing.assert_array_equal(read.info.start, start)


def test_h5_files_of_earlier_versions_are_read(tmp_path, rollout, panda):
    h5py = pytest.importorskip("h5py")
    path = write_recording(rollout, tmp_path / "run.h5")
    with h5py.File(path, "r+") as file:
        for name in ("tick", "start", "physics"):
            del file.attrs[name]
        file.attrs["seed"] = "none"
        fault = {"env": 1, "step": 10, "time": 0.005, "joint": "panda_joint4", "cause": "setpoint", "action": "hold"}
        file.attrs["faults"] = json.dumps([fault])
        file.attrs["complete"] = False
        del file["saturated"].attrs["unit"], file["checksum"], file.attrs["checksum"]
    read = read_recording(path)
    assert_identical(read, rollout)
    assert read.tick == rollout.tick
    assert (read.info.seed, read.info.physics, read.info.complete) == (None, None, False)
    assert [fault.joint for fault in read.info.faults] == ["panda_joint4"]


@pytest.mark.parametrize("path", ["run.csv", "run", 3, None, "a\0b.npz"])
def test_bad_paths_are_refused(path, rollout):
    with pytest.raises(InvalidArgumentError, match="path"):
        write_recording(rollout, path)


def test_bad_arguments_are_refused(tmp_path, rollout):
    with pytest.raises(InvalidArgumentError, match="rollout"):
        write_recording(None, tmp_path / "run.npz")
    with pytest.raises(InvalidArgumentError, match="seed"):
        write_recording(rollout, tmp_path / "run.npz", seed=-1)
    with pytest.raises(InvalidArgumentError, match="every"):
        read_recording(tmp_path / "run.npz", every=0)
    assert not os.listdir(tmp_path)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_files_that_are_no_recordings_are_refused_by_name(suffix, tmp_path):
    skip_without_h5py(suffix)
    missing, text, other = (tmp_path / f"{name}{suffix}" for name in ("missing", "text", "other"))
    text.write_text("hello")
    if suffix == ".npz":
        np.savez(other, a=np.zeros(3))
    else:
        import h5py

        with h5py.File(other, "w") as file:
            file["x"] = 1
    for path in (text, other):
        with pytest.raises(RecordingError, match=rf"{path.name}: cannot be read as a recording: "):
            read_recording(path)
    with pytest.raises(RecordingError, match=rf"{missing.name}: there is no such file; after a kill look for"):
        read_recording(missing)
    with pytest.raises(BatchPIDError):
        read_recording(tmp_path)


def test_pickled_objects_are_not_loaded(tmp_path, rollout):
    path = write_recording(rollout, tmp_path / "run.npz")
    with np.load(path) as file:
        np.savez(path, **(dict(file) | {"qpos": np.array([{}], object)}))
    with pytest.raises(RecordingError, match=r"cannot be read as a recording: its qpos is of object"):
        read_recording(path)


def virtual(h5py, file, elsewhere):
    layout = h5py.VirtualLayout((6, 3, 9), "f4", maxshape=(None, 3, 9))
    source = h5py.VirtualSource(elsewhere, "qpos", (6, 3, 9), maxshape=(None, 3, 9))
    layout[0 : h5py.h5s.UNLIMITED : 1] = source[0 : h5py.h5s.UNLIMITED : 1]
    file.create_virtual_dataset("qpos", layout)


STRANGE = {
    "external link": (
        lambda h5py, file, elsewhere: file.__setitem__("qpos", h5py.ExternalLink(elsewhere, "/qpos")),
        "qpos is a link",
    ),
    "soft link": (lambda h5py, file, elsewhere: file.__setitem__("qpos", h5py.SoftLink("/qvel")), "qpos is a link"),
    "virtual dataset": (virtual, "qpos is stored in other files"),
    "external storage": (
        lambda h5py, file, elsewhere: file.create_dataset("qpos", (6, 3, 9), "f4", external=[(elsewhere, 0, 648)]),
        "qpos is stored in other files",
    ),
    "huge shape": (
        lambda h5py, file, elsewhere: file.create_dataset("qpos", (10**12, 3, 9), "f4", chunks=(1, 3, 9)),
        "more than max_bytes",
    ),
    "huge times": (
        lambda h5py, file, elsewhere: (
            file.pop("checksum"),
            file.pop("time"),
            file.create_dataset("time", (10**12,), "f8", chunks=(8,), fillvalue=1.0),
        ),
        "more than max_bytes",
    ),
    "a group": (lambda h5py, file, elsewhere: file.create_group("qpos"), "qpos is not a dataset"),
    "text": (
        lambda h5py, file, elsewhere: file.create_dataset("qpos", data=[[["a"] * 9] * 3] * 6),
        "not an array of numbers",
    ),
    "other data": (
        lambda h5py, file, elsewhere: file.create_dataset("qpos", data=np.zeros((6, 3, 9), "f4")),
        "data are damaged: a checksum differs",
    ),
    "huge chunk": (
        lambda h5py, file, elsewhere: file.create_dataset("qpos", (2**26, 3), "u1", chunks=(2**26, 3)),
        "qpos has shape",
    ),
}


@pytest.mark.quick_rows(2)
@pytest.mark.parametrize("case", STRANGE)
def test_h5_files_of_strangers_open_no_other_file_and_take_no_memory(case, tmp_path, rollout):
    h5py = pytest.importorskip("h5py")
    change, message = STRANGE[case]
    path = write_recording(rollout, tmp_path / "run.h5")
    os.mkfifo(elsewhere := str(tmp_path / "elsewhere"))  # who opens it waits for good
    with h5py.File(path, "r+") as file:
        del file["qpos"]
        change(h5py, file, elsewhere)
    before = peak_memory()
    with pytest.raises(RecordingError, match=rf"run\.h5: cannot be read as a recording: .*{message}"):
        read_recording(path)
    assert peak_memory() < before + (1 << 30)


def peak_memory():
    """Return the largest resident memory of this process and of its children so far [B]."""
    return 1024 * sum(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))


def npy_header(shape, dtype="<f4"):
    text = str({"descr": dtype, "fortran_order": False, "shape": shape}).encode()
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text


@pytest.mark.parametrize("case", ["claimed shape", "claimed size", "unpacked size", "huge item", "lzma", "longer"])
def test_npz_files_of_strangers_take_no_memory(case, tmp_path, rollout):
    path = write_recording(rollout, tmp_path / "run.npz")
    options = {"max_bytes": 100_000} if case == "unpacked size" else {}
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    members["qpos.npy"] = {
        "claimed shape": npy_header((10**8, 3, 9)),
        "huge item": npy_header((1,), "<U500000000"),
        "longer": npy_header((1, 3, 9)) + members["qpos.npy"][-108:] * 6,
        "unpacked size": bytes(200_000),
    }.get(case, members["qpos.npy"])
    with zipfile.ZipFile(path, "w", zipfile.ZIP_LZMA if case == "lzma" else zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
        if case == "claimed size":
            archive.getinfo("qpos.npy").file_size = 10**12
    before = peak_memory()
    with pytest.raises(RecordingError, match=r"run\.npz: cannot be read as a recording"):
        read_recording(path, **options)
    assert peak_memory() < before + (1 << 30)


def test_an_npz_file_whose_directory_ends_early_is_refused(tmp_path, rollout):
    path = write_recording(rollout, tmp_path / "run.npz")
    content = bytearray(path.read_bytes())
    entry = content.rindex(b"PK\x01\x02", 0, content.index(b"begun.npy", content.index(b"PK\x01\x02")) - 46)
    rest = content.index(b"PK\x05\x06") - entry - 46 - int.from_bytes(content[entry + 28 : entry + 30], "little")
    content[entry + 32 : entry + 34] = rest.to_bytes(2, "little")  # the length of its comment
    path.write_bytes(content)
    with pytest.raises(RecordingError, match="list of arrays is damaged"):
        read_recording(path)


def test_a_limit_of_size_can_be_given(tmp_path, rollout):
    path = write_recording(rollout, tmp_path / "run.npz")
    assert_identical(read_recording(path, max_bytes=10**6), rollout)
    with pytest.raises(RecordingError, match="more than max_bytes=1,000"):
        read_recording(path, max_bytes=1000)
    with pytest.raises(InvalidArgumentError, match="max_bytes"):
        read_recording(path, max_bytes=-1)


def test_hdf5_that_hangs_or_crashes_is_ended(tmp_path, monkeypatch):
    pytest.importorskip("h5py")
    os.mkfifo(path := tmp_path / "run.h5")
    monkeypatch.setattr(hdf5, "SECONDS", 0.5)
    with pytest.raises(ValueError, match="takes too long"):
        hdf5.read_hdf5(path, ["time"], 1, 10**9)
    monkeypatch.setattr(sys, "executable", shutil.which("false"))
    with pytest.raises(ValueError, match="crashed"):
        hdf5.read_hdf5(path, ["time"], 1, 10**9)


@pytest.mark.parametrize("path", [".", "", "/", "..", "a" * 5000, "/dev/null", "run.h5/more"])
def test_paths_of_no_file_are_refused(path):
    with pytest.raises(RecordingError):
        read_recording(path)
