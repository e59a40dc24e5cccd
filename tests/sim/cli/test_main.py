"""The command line as a whole: its commands, its exit statuses, its messages."""

from __future__ import annotations

import dataclasses
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path
from typing import Annotated

import psutil
import pytest
from processes import PATIENCE, have_ended

from batchpid import __version__ as version
from batchpid.arrays.field_tables import Field
from batchpid.errors import InvalidArgumentError
from batchpid.sim import cli


@dataclasses.dataclass(frozen=True)
class Stub:
    """A command for tests."""

    number: Annotated[int, Field(high=255)] = 0
    """Exit status."""

    imports = ()
    failure = None

    def run(self) -> int:
        if self.failure is not None:
            raise self.failure
        return self.number


@pytest.fixture
def stub(monkeypatch):
    monkeypatch.setitem(cli.COMMANDS, "stub", Stub)
    return Stub


def fields_of(name: str) -> dict[str, dataclasses.Field]:
    """Return the fields of a command, options of the Runner among them."""
    own = {field.name: field for field in dataclasses.fields(cli.COMMANDS[name])}
    options = dataclasses.fields(own.pop("runner").default_factory) if "runner" in own else ()
    return own | {field.name: field for field in options}


def test_the_overview_lists_every_command_with_one_line(batchpid):
    status, out, _ = batchpid("--help")
    assert status == 0
    text = " ".join(out.replace("│", " ").split())
    for name, command in cli.COMMANDS.items():
        assert len(command.__doc__.splitlines()[0]) < 105
        assert f"• {name} {command.__doc__.splitlines()[0]}" in text


def test_a_missing_or_unknown_command_lists_those_there_are(batchpid):
    for arguments in ((), ("rolout",)):
        status, out, err = batchpid(*arguments)
        assert (status, out) == (2, "")
        assert all(name in err for name in cli.COMMANDS)


@pytest.mark.parametrize("value", ["", "1"])
def test_no_color_holds_in_help(value, batchpid, monkeypatch):
    monkeypatch.setenv("NO_COLOR", value)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    assert ("\x1b[" in batchpid("demo", "--help")[1]) == (not value)


def test_version(batchpid):
    assert batchpid("--version") == (0, f"{version}\n", "")


@pytest.mark.parametrize("name", list(cli.COMMANDS))
def test_every_command_is_a_frozen_dataclass_with_help(name, batchpid):
    command = cli.COMMANDS[name]
    assert dataclasses.is_dataclass(command)
    assert command.__dataclass_params__.frozen
    assert command.__name__ == f"{name.title()}Command"
    status, out, _ = batchpid(name, "--help")
    assert status == 0
    assert " ".join(command.__doc__.split()) in " ".join(out.split())
    flags = fields_of(name).keys() - {"weights", "meshes"}  # their fields are flags
    assert all(
        f"-{flag}".replace("_", "-") in out or flag.upper() in out for flag in flags
    )  # --flag or --no-flag


@pytest.mark.parametrize("name", [name for name in cli.COMMANDS if "robot" in fields_of(name)])
def test_the_robot_is_positional_and_its_meshes_may_be_missing(name):
    recording = ["run.h5"] if "recording" in fields_of(name) else []
    parsed = cli.parse(
        [name, *recording, "jaco2", "--missing-meshes", "error", "--package-dirs", "a", "b"]
    )
    assert parsed.robot == "jaco2"
    assert vars(parsed.meshes) == {
        "missing_meshes": "error",
        "package_dirs": (Path("a"), Path("b")),
    }


@pytest.mark.parametrize("name", ["meshes", "seed", "randomize"])
def test_a_flag_has_the_same_type_and_default_in_every_command(name):
    fields = [fields_of(command)[name] for command in cli.COMMANDS if name in fields_of(command)]
    assert len(fields) >= 2
    assert len({(str(field.type), field.default) for field in fields}) == 1


def test_flags_reach_the_command_and_its_status_is_returned(batchpid, stub):
    assert batchpid("stub", "--number", "7")[0] == 7
    assert batchpid("stub", "--number", "x")[0] == 2


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
def test_failures_are_one_line_and_a_status(batchpid, stub, monkeypatch, failure, status, message):
    monkeypatch.setattr(stub, "failure", failure)
    got, _, err = batchpid("stub")
    assert got == status
    assert err.startswith("batchpid: ")
    assert message in err
    assert err.count("\n") == 1


def test_a_bug_keeps_its_traceback(stub, monkeypatch):
    monkeypatch.setattr(stub, "failure", ZeroDivisionError())
    with pytest.raises(ZeroDivisionError):
        cli.main(["stub"])


def test_warnings_are_one_line(batchpid, stub, monkeypatch):
    def run(self):
        warnings.simplefilter("always")
        warnings.warn("joint 4 cannot reach 1", UserWarning, stacklevel=1)

    monkeypatch.setattr(stub, "run", run)
    before = warnings.showwarning
    assert batchpid("stub") == (0, "", "batchpid: warning: joint 4 cannot reach 1\n")
    assert warnings.showwarning is before


def test_help_loads_nothing_heavy():
    """One process asks for the help of all: what one loads stays loaded, and names it."""
    code = """
import sys
from batchpid.sim.cli import COMMANDS, main

for words in (["--help"], *([name, "--help"] for name in COMMANDS)):
    main(words)
    heavy = {"jax", "sapien", "matplotlib", "h5py"} & set(sys.modules)
    assert not heavy, (words, heavy)
"""
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)


def test_a_reader_that_ends_is_a_status_without_a_line(tmp_path):
    line = f"{sys.executable} -m batchpid inspect panda --all | head -c 1; exit ${{PIPESTATUS[0]}}"
    ran = subprocess.run(["bash", "-c", line], cwd=tmp_path, capture_output=True, text=True)
    assert ran.returncode in (0, 141)
    assert ran.stderr == ""


@pytest.mark.parametrize("seconds", [0.0, 3.0])
def test_ctrl_c_ends_a_command_in_one_line_and_its_processes(seconds, tmp_path):
    words = ["demo", "--num-envs", "2", "--workers", "2", "--seconds", "1000"]
    process = subprocess.Popen(
        [sys.executable, "-m", "batchpid", *words],
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        cwd=tmp_path,
    )
    assert "2 robots in" in process.stdout.readline().decode()  # the packages are imported
    time.sleep(seconds)
    family = psutil.Process(process.pid).children(recursive=True)
    process.send_signal(signal.SIGINT)
    error = process.communicate(timeout=PATIENCE)[1].decode()
    assert (process.returncode, error.splitlines()[-1]) == (130, "batchpid: interrupted")
    assert "Traceback" not in error
    assert have_ended([child.pid for child in family])
