"""The distribution: every package and data file is in it, every extra exists."""

import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest
import yaml
from setuptools import find_packages
from setuptools.config.expand import read_attr

import batchpid
from batchpid.sim.engine.sapien.calls import TESTED

ROOT = Path(__file__).parents[1]
LIMITED_API = "cp311"
REQUIRED = "BATCHPID_REQUIRE_NATIVE"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def test_every_package_is_shipped():
    include = PROJECT["tool"]["setuptools"]["packages"]["find"]["include"]
    packages = {
        ".".join(path.parent.relative_to(ROOT).parts)
        for folder in ("batchpid", "batchpid/sim", "batchpid/assets")
        for path in (ROOT / folder).rglob("*.py")
    }
    assert set(find_packages(str(ROOT), include=include)) == packages


def test_the_package_is_found_from_the_folder_above_the_checkout_too(tmp_path):
    """There Python's path offers the checkout itself, if it is named batchpid, as a namespace
    package.
    """
    if Path(batchpid.__file__).parents[1] != ROOT:
        pytest.skip("the package is not that of the checkout")
    (tmp_path / "batchpid").symlink_to(ROOT)
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    code = (
        "import batchpid; from batchpid.sim import Robot; print(batchpid.__file__,"
        " batchpid.make_params)"
    )
    for folder in (tmp_path, Path("/")):
        shown = subprocess.run(
            [sys.executable, "-c", code], cwd=folder, env=clean, capture_output=True, text=True
        )
        assert str(Path("batchpid", "__init__.py")) in shown.stdout, (folder, shown.stderr)


def test_every_data_file_is_shipped():
    data = PROJECT["tool"]["setuptools"]["package-data"]
    for package, patterns in data.items():
        folder = ROOT / package.replace(".", "/")
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


def test_the_command_checks_the_packages_before_it_imports_them():
    assert PROJECT["project"]["scripts"] == {"batchpid": "batchpid.__main__:main"}


@pytest.mark.parametrize(
    ("required", "status", "message"),
    [
        pytest.param("0", 0, "", marks=pytest.mark.slow),
        ("1", 1, "cannot be built"),
        pytest.param(
            "yes", 1, "BATCHPID_REQUIRE_NATIVE is 'yes'; set it to 1", marks=pytest.mark.slow
        ),
    ],
)
def test_a_failed_extension_ends_a_build_that_requires_it(required, status, message, tmp_path):
    folders = ["--build-lib", str(tmp_path / "lib"), "--build-temp", str(tmp_path / "temp")]
    build = [sys.executable, "-W", "ignore", "setup.py", "--quiet", "build_ext", *folders]
    compilers = {"CC": "/bin/false", "CXX": "/bin/false", REQUIRED: required}
    done = subprocess.run(
        build, cwd=ROOT, env=os.environ | compilers, capture_output=True, text=True
    )
    assert done.returncode == status
    assert message in done.stderr
    assert not list(tmp_path.rglob("*.so"))


def test_published_wheels_have_native_code_and_the_tag_of_the_limited_api():
    workflow = yaml.safe_load((ROOT / ".github/workflows/wheels.yml").read_text())
    variables = workflow["env"]
    assert "BATCHPID_REQUIRE_NATIVE=1" in variables["CIBW_ENVIRONMENT"]
    assert variables["CIBW_BUILD"] == f"{LIMITED_API}-manylinux_x86_64"
    assert f'"py_limited_api": "{LIMITED_API}"' in (ROOT / "setup.py").read_text()
    oldest = PROJECT["project"]["requires-python"].removeprefix(">=3.")
    assert f"cp3{oldest}" == LIMITED_API


def test_the_tests_run_with_every_sapien_that_native_code_calls():
    workflow = yaml.safe_load((ROOT / ".github/workflows/wheels.yml").read_text())
    assert workflow["jobs"]["tests"]["strategy"]["matrix"]["sapien"] == list(TESTED)
    assert "tests/sim/test_conformance.py" in str(workflow["jobs"]["tests"]["steps"])


@pytest.mark.slow
@pytest.mark.skipif(
    not (ROOT / ".git").exists(), reason="the files of a checkout are those that git knows"
)
def test_the_sdist_has_every_file_builds_and_passes_tests(tmp_path):
    """The tests of the distribution, of its native code and of a run."""
    listed = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout
    files = {name for name in listed.split("\0") if name}
    for name in files:
        (copy := tmp_path / "checkout" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, copy, follow_symlinks=False)
    setup = [sys.executable, "-W", "ignore", "setup.py", "--quiet"]
    subprocess.run([*setup, "sdist", "--dist-dir", tmp_path], cwd=tmp_path / "checkout", check=True)
    with tarfile.open(next(tmp_path.glob("*.tar.gz"))) as archive:
        archive.extractall(tmp_path, filter="data")
    (sdist,) = tmp_path.glob("batchpid-*/")
    links = {"batchpid/sim", "batchpid/assets"}
    own = {".gitignore", ".pre-commit-config.yaml"}
    lacking = {name for name in files - links - own if not (sdist / name).exists()}
    assert {name for name in lacking if not (sdist / "batchpid" / name).exists()} == set()
    subprocess.run(
        [*setup, "build_ext", "--inplace"], cwd=sdist, env=os.environ | {REQUIRED: "1"}, check=True
    )
    tests = (
        "tests/test_packaging.py",
        "tests/assets",
        "tests/batchpid/native",
        "tests/sim/test_conformance.py",
    )
    environment = os.environ | {"PYTHONPATH": str(sdist)}
    subprocess.run([sys.executable, "-m", "pytest", *tests], cwd=sdist, env=environment, check=True)


@pytest.mark.slow
def test_an_installed_wheel_shares_an_environment_with_another_package_called_sim(tmp_path):
    build = [sys.executable, "-W", "ignore", "-m", "pip", "wheel", "--quiet", "--no-deps"]
    subprocess.run([*build, "--wheel-dir", tmp_path, ROOT], check=True)
    (wheel,) = tmp_path.glob("batchpid-*.whl")
    site = tmp_path / "site"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    installed = {path.name for path in site.iterdir() if path.suffix != ".dist-info"}
    assert installed == {"batchpid"}
    assert {path.name for path in (site / "batchpid").rglob("*.so")} == {
        f"{name}.abi3.so" for name in ("_program", "_task_space", "_gateway")
    }
    (site / "sim.py").write_text("def joints(): return 3")
    code = """
import sim
from batchpid.sim import Robot, Runner
with Runner(Robot.load("panda"), num_envs=2, workers=1) as runner:
    assert runner.step(runner.reset().qpos).ok.all()
assert sim.joints() == 3
"""
    subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(site)},
        check=True,
    )
