"""The distribution: every package and data file is in it, every extra exists."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

from setuptools import find_packages

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def test_every_package_is_shipped():
    include = PROJECT["tool"]["setuptools"]["packages"]["find"]["include"]
    packages = {
        ".".join(path.parent.relative_to(ROOT).parts)
        for top in ("batchpid", "sim", "assets")
        for path in (ROOT / top).rglob("*.py")
    }
    assert set(find_packages(str(ROOT), include=include)) == packages


def test_every_data_file_is_shipped():
    data = PROJECT["tool"]["setuptools"]["package-data"]
    for package, patterns in data.items():
        folder = ROOT / package
        shipped = {path for pattern in patterns for path in folder.glob(pattern)}
        there = {path for path in folder.iterdir() if path.is_file() and path.suffix != ".py"}
        assert there == shipped


def test_every_extra_that_another_extra_names_exists():
    extras = PROJECT["project"]["optional-dependencies"]
    for needs in extras.values():
        for need in needs:
            if chosen := re.fullmatch(r"batchpid\[(.*)\]", need):
                assert set(chosen[1].split(",")) <= set(extras)


def test_the_command_checks_the_packages_before_it_imports_them():
    assert PROJECT["project"]["scripts"] == {"batchpid": "batchpid.__main__:main"}
