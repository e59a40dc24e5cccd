"""The survey: one report for each file, for every outcome."""

from __future__ import annotations

import shutil
import sys

import pytest
from tiny_urdf import one_joint

from batchpid.errors import InvalidArgumentError
from batchpid.sim.tuning import find_robots, survey


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("robots")
    (folder / "deep").mkdir()
    (folder / "deep" / "arm.urdf").write_text(one_joint())
    (folder / "scenery.urdf").write_text("<robot name='table'><link name='top'/></robot>")
    (folder / "truncated.urdf").write_text(one_joint()[:200])
    (folder / "notes.txt").write_text("no robot")
    return folder


@pytest.mark.slow
def test_a_robot_that_takes_too_long_is_ended(folder):
    (report,) = survey([folder / "deep" / "arm.urdf"], moves=1000, seconds=600.0, time_limit=2.0)
    assert report.error.endswith("more than 2 s")


def test_a_process_that_ends_at_once_is_an_error_of_its_robot(folder, monkeypatch):
    monkeypatch.setattr(sys, "executable", shutil.which("false"))
    (report,) = survey([folder / "deep" / "arm.urdf"])
    assert report.error == "reading the description: exit status 1"


def test_files_and_folders_are_found_once(folder):
    arm = folder / "deep" / "arm.urdf"
    assert find_robots([arm, folder]) == [arm, folder / "scenery.urdf", folder / "truncated.urdf"]
    with pytest.raises(InvalidArgumentError, match="must be files or folders"):
        find_robots([folder / "nothing"])
    (folder / "empty").mkdir()
    with pytest.raises(InvalidArgumentError, match=r"hold no file \*.urdf and no MJCF"):
        find_robots([folder / "empty"])


def test_folders_are_searched_for_urdf_and_mjcf_files(tmp_path):
    """Suffixes in capitals and MJCF count; parts that others include, and other XML, do not."""
    deep = tmp_path / "deep"
    (deep / "parts").mkdir(parents=True)
    include = '<mujoco><include file="{}"/></mujoco>'
    files = {
        tmp_path / "ARM.URDF": one_joint(),
        tmp_path / "other.xml": "<package/>",
        tmp_path / "broken.xml": "<mujoco",
        tmp_path / "hand.MJCF": "<mujoco/>",
        tmp_path / "scene.xml": include.format("deep/arm.xml"),
        deep / "arm.xml": include.format("parts/motors.xml"),
        deep / "parts" / "motors.xml": '<mujoco xmlns="urn:mujoco"/>',
        deep / "leg.xml": '<mujoco xmlns="urn:mujoco"/>',
    }
    for path, text in files.items():
        path.write_text(text)
    assert {path.name for path in find_robots([tmp_path])} == {"ARM.URDF", "hand.MJCF", "scene.xml", "leg.xml"}
