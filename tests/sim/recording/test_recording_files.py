"""Rollouts are read from files as they were written, and damaged files are refused with their names."""

from __future__ import annotations

import json
import os
from dataclasses import fields, replace

import numpy as np
import pytest
from identical import assert_identical

from batchpid.errors import BatchPIDError, InvalidArgumentError
from sim import FaultWarning, RecordingError, RunInfo, Runner, read_recording, write_recording

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
    assert (read.info.physics, read.info.compensate, read.info.complete) == ("fast", "gravity+coriolis", True)
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
        del file["saturated"].attrs["unit"]
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


def test_a_damaged_npz_file_is_refused(tmp_path, rollout):
    path = write_recording(rollout, tmp_path / "run.npz")
    whole = path.read_bytes()
    random = np.random.default_rng(0)
    for _ in range(50):
        spoilt = bytearray(whole)
        for place in random.integers(0, len(whole), 40):
            spoilt[place] ^= 255
        path.write_bytes(spoilt)
        with pytest.raises(RecordingError, match=r"run\.npz: cannot be read as a recording"):
            read_recording(path)
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(RecordingError, match=r"run\.npz: cannot be read as a recording"):
        read_recording(path)


def test_pickled_objects_are_not_loaded(tmp_path, rollout):
    path = write_recording(rollout, tmp_path / "run.npz")
    with np.load(path) as file:
        np.savez(path, **(dict(file) | {"qpos": np.array([{}], object)}))
    with pytest.raises(RecordingError, match=r"cannot be read as a recording: .*allow_pickle"):
        read_recording(path)


DAMAGE = {
    "no names": (lambda file: file.attrs.pop("joint_names"), "does not say its joint_names"),
    "no robot": (lambda file: file.attrs.pop("robot"), "does not say its robot"),
    "another format": (lambda file: file.attrs.create("format", "other-1"), "format is 'other-1'"),
    "other params": (lambda file: file.attrs.create("params", "{}"), "params"),
    "no JSON": (lambda file: file.attrs.create("faults", "}"), "JSON|Expecting"),
    "other faults": (lambda file: file.attrs.create("faults", json.dumps([{"a": 1}])), "unexpected keyword"),
    "a group": (lambda file: (file.pop("qpos"), file.create_group("qpos")), "slice"),
    "other joints": (
        lambda file: file.attrs.create("joint_names", ["a", "b"]),
        r"units are \(9,\), not one for each of 2",
    ),
    "other limits": (lambda file: file.attrs.create("upper", 3.0), r"upper are \(\), not one for each of 9"),
    "other envs": (
        lambda file: (file.pop("qvel"), file.create_dataset("qvel", data=np.zeros((6, 2, 9), "f4"))),
        r"qvel has shape \(6, 2, 9\), not \(6, 3, 9\)",
    ),
    "text": (lambda file: (file.pop("ok"), file.create_dataset("ok", data=[["a", "b", "c"]] * 6)), "Cannot cast"),
}


@pytest.mark.parametrize("case", DAMAGE)
def test_a_damaged_h5_file_is_refused(case, tmp_path, rollout):
    h5py = pytest.importorskip("h5py")
    damage, message = DAMAGE[case]
    path = write_recording(rollout, tmp_path / "run.h5")
    with h5py.File(path, "r+") as file:
        damage(file)
    with pytest.raises(RecordingError, match=rf"run\.h5: cannot be read as a recording: .*({message})"):
        read_recording(path)
