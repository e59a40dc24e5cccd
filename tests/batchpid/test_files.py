"""Atomic writes and package versions."""

import ast
import importlib.metadata
import platform
from pathlib import Path

import numpy as np
import pytest

import batchpid
from batchpid.io.files import try_writing, write_atomically
from batchpid.io.versions import package_versions


@pytest.mark.parametrize("content", ["ä", "ä".encode(), lambda file: file.write("ä".encode())])
def test_text_bytes_and_writers_replace_a_file(content, tmp_path):
    path = tmp_path / "file"
    path.write_text("older")
    write_atomically(path, content)
    assert path.read_text(encoding="utf-8") == "ä"
    assert list(tmp_path.iterdir()) == [path]


def test_a_write_that_fails_leaves_the_older_file(tmp_path):
    path = tmp_path / "file"
    path.write_text("older")

    def fail(file):
        file.write(b"half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_atomically(path, fail)
    assert path.read_text() == "older"
    assert list(tmp_path.iterdir()) == [path]


def test_an_error_names_the_file_and_not_the_temporary_one(tmp_path):
    path = tmp_path / "none" / "file"
    with pytest.raises(FileNotFoundError) as raised:
        write_atomically(path, "text")
    assert raised.value.filename == str(path)


def test_a_link_stays_a_link(tmp_path):
    (link := tmp_path / "link").symlink_to("file")
    write_atomically(link, "text")
    assert link.is_symlink()
    assert (tmp_path / "file").read_text() == "text"


def test_a_trial_leaves_nothing_and_names_what_is_no_file(tmp_path):
    try_writing(tmp_path / "new" / "folder" / "file")
    assert list(tmp_path.iterdir()) == []
    (path := tmp_path / "file").write_text("older")
    try_writing(path)
    assert path.read_text() == "older"
    for place in (tmp_path, path / "more", "/dev/null", tmp_path / ("a" * 300), "/proc/file"):
        with pytest.raises(OSError, match=r".") as raised:
            try_writing(place)
        assert raised.value.strerror
    assert list(tmp_path.iterdir()) == [path]


NOT_FILES = {
    "batchpid/io/files.py": "the atomic writer",
    "sim/engine/sapien/building.py": "text in memory",
    "sim/recording/partial_file.py": "space for a growing recording",
    "sim/view/film.py": "messages in memory",
}


@pytest.mark.slow
def test_every_file_is_written_by_the_atomic_writer():
    root = Path(batchpid.__file__).parents[1]
    folders = ("batchpid", "sim", "bench", "examples")
    for path in (path for folder in folders for path in (root / folder).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.Call) or str(path.relative_to(root)) in NOT_FILES:
                continue
            name = getattr(node.func, "attr", getattr(node.func, "id", ""))
            last = node.args[-1].value if node.args and isinstance(node.args[-1], ast.Constant) else None
            mode = last if name == "open" and isinstance(last, str) and set(last) <= set("rwax+bt") else "r"
            assert not set(mode) & set("wax+"), f"{path}:{node.lineno}"
            assert name not in ("write_text", "write_bytes", "tofile", "imsave"), f"{path}:{node.lineno}"


def test_the_own_version_is_that_of_the_tree_in_use_installed_or_not(monkeypatch):
    def not_installed(name):
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "version", not_installed)
    assert package_versions(("batchpid", "numpy")).keys() == {"python", "batchpid"}
    assert package_versions(("batchpid",))["batchpid"] == batchpid.__version__


def test_versions_are_those_of_installed_packages():
    versions = package_versions(("numpy", "no-such-package"))
    assert versions == {"python": platform.python_version(), "numpy": np.__version__}
