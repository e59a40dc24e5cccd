"""``batchpid plot`` refuses odd paths and disks that are full or read-only in one line, and keeps the older picture."""

from __future__ import annotations

import resource

import pytest

from batchpid.sim import Runner, write_recording


@pytest.fixture(scope="module")
def recording(panda, tmp_path_factory):
    """A recording of 4 ticks."""
    with Runner(panda, 2, workers=0, substeps=2) as runner:
        rollout = runner.rollout([[panda.start] * 2] * 4)
    return write_recording(rollout, tmp_path_factory.mktemp("recording") / "run.npz")


@pytest.mark.parametrize("path", [".", "", "/", "..", "a" * 5000, "/dev/null", "none.npz", "run\n.h5"])
def test_odd_paths_are_refused_in_one_line(path, batchpid, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    status, out, err = batchpid("plot", path)
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("picture", ["folder.png", "run.npz/run.png", "run.pdf"])
def test_pictures_that_cannot_be_written_are_refused_before_the_recording_is_read(
    picture, batchpid, recording, tmp_path, monkeypatch
):
    monkeypatch.chdir(recording.parent)
    (recording.parent / "folder.png").mkdir(exist_ok=True)
    status, out, err = batchpid("plot", recording, "--picture", picture)
    assert (status, out, err.count("\n")) == (2, "", 1)


def test_a_full_disk_keeps_the_older_picture(batchpid, recording):
    picture = recording.with_name("run-responses.png")
    picture.write_text("older")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    try:
        status, _, err = batchpid("plot", recording, "--force")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert (status, err.count("\n")) == (2, 1)
    assert "File too large" in err
    assert picture.read_text() == "older"
