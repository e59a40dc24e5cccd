"""The distribution: every package and data file is in it, every extra exists."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

from setuptools import find_packages
from setuptools.config.expand import read_attr

import batchpid

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


def test_the_version_has_one_definition_which_the_package_knows():
    assert PROJECT["project"]["dynamic"] == ["version"]
    assert PROJECT["tool"]["setuptools"]["dynamic"] == {"version": {"attr": "batchpid.__version__"}}
    assert read_attr("batchpid.__version__", root_dir=ROOT) == batchpid.__version__
    assert re.fullmatch(r"\d+\.\d+\.\d+", batchpid.__version__)


def test_classifiers_name_the_versions_of_python_that_it_runs_on():
    listed = re.findall(r":: Python :: 3\.(\d+)", "\n".join(PROJECT["project"]["classifiers"]))
    assert list(map(int, listed)) == [11, 12, 13]
    assert PROJECT["project"]["requires-python"] == ">=3.11"


def test_the_command_checks_the_packages_before_it_imports_them():
    assert PROJECT["project"]["scripts"] == {"batchpid": "batchpid.__main__:main"}
