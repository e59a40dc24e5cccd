"""Files are replaced as a whole, and by one writer."""

import os
import re
from pathlib import Path

import pytest

import batchpid as bp
from batchpid.io.files import write_atomically

PARAMS = bp.make_params(1, 2.0)


def test_a_file_is_replaced_and_a_link_stays_a_link(tmp_path):
    (link := tmp_path / "link.yaml").symlink_to("file.yaml")
    for gain in (1.0, 2.0):
        bp.save_params(link, bp.make_params(1, gain), ["Gelenk für Rück"])
    assert link.is_symlink()
    assert bp.load_params(tmp_path / "file.yaml")[1] == ["Gelenk für Rück"]
    assert bp.load_params(link)[0].kp.item() == 2.0
    assert len(list(tmp_path.iterdir())) == 2


def test_an_error_names_the_file_and_not_the_temporary_one(tmp_path):
    path = tmp_path / "none" / "file.yaml"
    with pytest.raises(FileNotFoundError) as raised:
        bp.save_params(path, PARAMS, ["a"])
    assert raised.value.filename == str(path)


def test_a_pipe_or_device_is_not_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OSError, match="not a regular file"):
        write_atomically(tmp_path / "pipe", "text")
    assert (tmp_path / "pipe").is_fifo()


def test_a_write_that_fails_leaves_the_older_file(tmp_path, monkeypatch):
    path = tmp_path / "file.yaml"
    bp.save_params(path, PARAMS, ["a"])
    older = path.read_bytes()

    def full(*_):
        raise OSError("no space left")

    monkeypatch.setattr("pathlib.Path.replace", full)
    with pytest.raises(OSError, match="no space"):
        bp.save_params(path, bp.make_params(1, 3.0), ["a"])
    assert path.read_bytes() == older
    assert list(tmp_path.iterdir()) == [path]


NOT_FILES = {
    "batchpid/io/files.py": "the atomic writer",
    "sim/engine/sapien/building.py": "text in memory",
    "sim/view/view_data.py": "a URDF in a temporary folder",
}


WRITE = re.compile(
    r"\.write_text\(|\.write_bytes\(|\.tofile\(|imsave\(|open\([^()]*[\"'][rbt+]*[wax+][rbt+]*[\"']"
)


def test_every_file_is_written_by_the_atomic_writer():
    root = Path(bp.__file__).parents[1]
    for path in (path for folder in ("batchpid", "sim") for path in (root / folder).rglob("*.py")):
        if str(path.relative_to(root)) not in NOT_FILES:
            assert not WRITE.findall(path.read_text()), path
