"""The distribution and its pages: every package is shipped, every link has a target, every make target exists."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
from setuptools import find_packages

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("assets/*.md")])


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


def test_every_extra_of_the_tests_exists():
    extras = PROJECT["project"]["optional-dependencies"]
    for needs in extras.values():
        for need in needs:
            if chosen := re.fullmatch(r"batchpid\[(.*)\]", need):
                assert set(chosen[1].split(",")) <= set(extras)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.S)
    for target in re.findall(r"\]\(([^)#\s]+)", text):
        if "://" not in target:
            assert (page.parent / target).exists(), target


def test_the_readme_s_pictures_are_light():
    for target in re.findall(r"!\[[^\]]*\]\(([^)]+)\)", (ROOT / "README.md").read_text()):
        assert (ROOT / target).stat().st_size < 400_000, target


def test_make_targets_of_the_readme_exist():
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), flags=re.M))
    for page in (ROOT / "README.md", ROOT / "CONTRIBUTING.md"):
        named = set(re.findall(r"\bmake ([a-z]+)\b", page.read_text()))
        assert named
        assert named <= targets
