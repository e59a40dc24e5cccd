"""Rollouts are read from files as they were written, and other files are refused with their
names.
"""

import os
from dataclasses import fields, replace

import h5py
import numpy as np
import pytest
from identical import assert_identical

from batchpid.errors import BatchPIDError, InvalidArgumentError
from batchpid.sim import (
    FaultWarning,
    RecordingError,
    RunInfo,
    Runner,
    read_recording,
    write_recording,
)


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
            return runner.rollout(setpoints, feedforwards=0.1 * np.ones((6, 9)))


def assert_same_info(first, second):
    for field in fields(RunInfo):
        ours, theirs = getattr(first, field.name), getattr(second, field.name)
        if field.name == "urdf":
            continue  # test_view draws it
        if field.name == "description":
            assert ours is None
            continue
        if field.name == "params" and theirs is not None:
            assert all(np.array_equal(one, other) for one, other in zip(ours, theirs, strict=True))
        elif isinstance(theirs, np.ndarray):
            np.testing.assert_array_equal(ours, theirs, strict=True)
        else:
            assert ours == theirs, field.name


def test_rollouts_are_read_as_they_were_written(tmp_path, rollout):
    path = tmp_path / "new" / "run.h5"
    assert write_recording(rollout, path) == path
    read = read_recording(path)
    assert_identical(read, rollout)
    np.testing.assert_array_equal(read.feedforward, rollout.feedforward)
    assert read.tick == rollout.tick == 0.001
    assert_same_info(read.info, rollout.info)
    (fault,) = read.info.faults
    assert (fault.env, fault.joint, fault.cause) == (1, "panda_joint4", "setpoint")
    assert (read.info.physics, read.info.compensate) == ("fast", "gravity+coriolis+friction")
    with h5py.File(path) as file:  # as any reader of HDF5 sees it
        assert file["qpos"].attrs["unit"].tolist() == ["rad"] * 7 + ["m"] * 2
        assert file["qvel"].attrs["unit"][0] == "rad/s"
        assert file["time"].attrs["unit"].tolist() == ["s"]
    assert os.listdir(path.parent) == [path.name]


def test_rollouts_made_by_hand_and_empty_ones_can_be_written(tmp_path, rollout, panda):
    bare = replace(rollout, info=RunInfo.of(panda)).for_ticks(0, 0)
    with pytest.raises(InvalidArgumentError, match="rollout: holds no tick"):
        bare.plot()
    read = read_recording(write_recording(bare, tmp_path / "run.h5"))
    assert_identical(read, bare)
    assert_same_info(read.info, bare.info)


def test_existing_files_are_replaced_only_when_asked(tmp_path, rollout):
    path = tmp_path / "run.h5"
    path.write_text("precious")
    with pytest.raises(InvalidArgumentError, match=r"exists already.*run\.h5.*overwrite=True"):
        write_recording(rollout, path)
    assert path.read_text() == "precious"
    write_recording(rollout, path, overwrite=True)
    assert_identical(read_recording(path), rollout)


@pytest.mark.parametrize("path", ["run.csv", "run.npz", "run", 3, None, "a\0b.h5"])
def test_bad_paths_are_refused(path, rollout):
    with pytest.raises(InvalidArgumentError, match="path"):
        write_recording(rollout, path)


def test_bad_arguments_are_refused(tmp_path, rollout):
    with pytest.raises(InvalidArgumentError, match="rollout"):
        write_recording(None, tmp_path / "run.h5")
    assert not os.listdir(tmp_path)


def test_files_that_are_no_recordings_are_refused_by_name(tmp_path, rollout):
    text, other = tmp_path / "text.h5", tmp_path / "other.h5"
    text.write_text("hello")
    with h5py.File(other, "w") as file:
        file["x"] = 1
    shape = write_recording(rollout, tmp_path / "shape.h5")
    with h5py.File(shape, "r+") as file:
        del file["qpos"]
        file["qpos"] = np.zeros((6, 2, 9), np.float32)
    start = write_recording(rollout, tmp_path / "start.h5")
    with h5py.File(start, "r+") as file:
        file.attrs["start"] = np.zeros((1, 2))
    for path in (text, other, shape, start):
        with pytest.raises(RecordingError, match=rf"{path.name}: cannot be read as a recording: "):
            read_recording(path)


@pytest.mark.parametrize(
    "path", [".", "", "/", "..", "a" * 5000, "/dev/null", "run.h5/more", "missing.h5"]
)
def test_paths_of_no_file_are_refused(path):
    with pytest.raises(BatchPIDError):
        read_recording(path)
