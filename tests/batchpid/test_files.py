"""Atomic writes and package versions."""

import platform

import numpy as np
import pytest

from batchpid.files import write_atomically
from batchpid.versions import package_versions


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


def test_versions_are_those_of_installed_packages():
    versions = package_versions(("numpy", "no-such-package"))
    assert versions == {"python": platform.python_version(), "numpy": np.__version__}
