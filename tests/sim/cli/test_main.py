"""The command line as a whole: its table, its exit statuses, its manners."""

from __future__ import annotations

import dataclasses
import importlib.metadata
import subprocess
import sys
import warnings

import pytest

from batchpid.errors import InvalidArgumentError
from sim import cli


@dataclasses.dataclass(frozen=True)
class Probe:
    """Stands in for a command."""

    number: int = 0
    """Returned."""

    failure = None

    def run(self) -> int:
        if self.failure is not None:
            raise self.failure
        return self.number


@pytest.fixture
def probe(monkeypatch):
    monkeypatch.setitem(cli.COMMANDS, "probe", (f"{__name__}:Probe", "a probe"))
    return Probe


def test_without_a_command_lists_all(batchpid):
    status, out, _ = batchpid()
    assert status == 2
    assert all(f"  {name}" in out for name in cli.COMMANDS)
    assert batchpid("--help") == (0, out, "")


def test_version(batchpid, monkeypatch):
    monkeypatch.setattr(importlib.metadata, "version", {"batchpid": "1.2.3"}.__getitem__)
    assert batchpid("--version") == (0, "1.2.3\n", "")

    def not_installed(name):
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "version", not_installed)
    assert "not installed" in batchpid("--version")[1]


def test_unknown_command_names_the_nearest(batchpid):
    status, out, err = batchpid("rolout")
    assert (status, out) == (2, "")
    assert "did you mean 'rollout'?" in err
    assert "choose one of" in batchpid("xyz")[2]


@pytest.mark.parametrize("name", list(cli.COMMANDS))
def test_every_command_is_a_frozen_dataclass_with_help(name, batchpid):
    command = cli.load(name)
    assert dataclasses.is_dataclass(command)
    assert command.__dataclass_params__.frozen
    status, out, _ = batchpid(name, "--help")
    assert status == 0
    assert command.__doc__.split(".")[0] in " ".join(out.split())
    options = [line for line in out.splitlines() if "--" in line]
    assert len(options) >= 1


def test_flags_reach_the_command_and_its_status_comes_back(batchpid, probe):
    assert batchpid("probe", "--number", "7")[0] == 7
    assert batchpid("probe", "--number", "x")[0] == 2


@pytest.mark.parametrize(
    ("failure", "status", "message"),
    [
        (
            InvalidArgumentError("kp", "is negative", joint="elbow", remedy="give 0 or more"),
            2,
            "kp, joint 'elbow'",
        ),
        (KeyboardInterrupt(), 130, "interrupted"),
        (PermissionError(13, "Permission denied", "/x/y"), 2, "/x/y: Permission denied"),
    ],
)
def test_failures_are_one_line_and_a_status(batchpid, probe, monkeypatch, failure, status, message):
    monkeypatch.setattr(probe, "failure", failure)
    got, _, err = batchpid("probe")
    assert got == status
    assert err.startswith("batchpid: ")
    assert message in err
    assert err.count("\n") == 1


def test_a_bug_keeps_its_traceback(probe, monkeypatch):
    monkeypatch.setattr(probe, "failure", ZeroDivisionError())
    with pytest.raises(ZeroDivisionError):
        cli.main(["probe"])


def test_warnings_are_one_line(batchpid, probe, monkeypatch):
    def run(self):
        warnings.simplefilter("always")
        warnings.warn("joint 4 cannot reach 1", UserWarning, stacklevel=1)

    monkeypatch.setattr(probe, "run", run)
    before = warnings.showwarning
    assert batchpid("probe") == (0, "", "batchpid: warning: joint 4 cannot reach 1\n")
    assert warnings.showwarning is before


def test_help_loads_nothing_heavy():
    code = (
        "import sys; from sim.cli import main; main(['--help']); "
        "heavy = {'jax', 'sapien', 'matplotlib', 'h5py'} & set(sys.modules); assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)


@pytest.mark.parametrize("name", list(cli.COMMANDS))
def test_help_of_a_command_does_not_load_the_simulator(name):
    code = (
        "import sys; from sim.cli import main\n"
        f"try: main([{name!r}, '--help'])\n"
        "except SystemExit: pass\n"
        "heavy = {'jax', 'sapien', 'matplotlib', 'h5py'} & set(sys.modules); assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)


@pytest.mark.parametrize("name", ["sim", "assets"])
def test_a_file_of_the_user_that_hides_a_package_is_named_and_not_run(name, tmp_path):
    hiding = tmp_path / f"{name}.py"
    hiding.write_text("print('the user's own program')")
    ran = subprocess.run([sys.executable, "-m", "batchpid", "--help"], cwd=tmp_path, capture_output=True, text=True)
    assert (ran.returncode, ran.stdout) == (2, "")
    assert ran.stderr.startswith(f"batchpid: {hiding} hides the package {name!r}")
    assert ran.stderr.count("\n") == 1


@pytest.mark.parametrize("name", ["batchpid", "assets"])
def test_importing_sim_names_a_file_that_hides_a_package_it_needs(name, tmp_path):
    hiding = tmp_path / f"{name}.py"
    hiding.touch()
    ran = subprocess.run([sys.executable, "-c", "import sim"], cwd=tmp_path, capture_output=True, text=True)
    assert ran.stderr.splitlines()[-1].startswith(f"ImportError: {hiding} hides the package {name!r}")


def test_reader_may_leave_early():
    process = subprocess.Popen(
        [sys.executable, "-u", "-m", "batchpid", "inspect", "panda"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    process.stdout.close()  # before the first line is written
    assert process.wait() == 141
    assert process.stderr.read() == b""
    process.stderr.close()
