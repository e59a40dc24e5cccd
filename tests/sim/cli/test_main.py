"""The command line as a whole: its commands, its exit statuses, its messages."""

from __future__ import annotations

import dataclasses
import os
import re
import signal
import subprocess
import sys
import time
import warnings
from typing import Annotated, NamedTuple, get_args

import psutil
import pytest
from processes import PATIENCE, have_ended

from batchpid import __version__ as version
from batchpid.arrays.field_tables import Field
from batchpid.errors import InvalidArgumentError
from batchpid.sim import cli
from batchpid.sim.cli.commands import COMMANDS, CommandFunction
from batchpid.sim.cli.flags import flag


class Result(NamedTuple):
    """Result of the stub."""

    number: int

    def report(self):
        """Return a text."""
        return f"done {self.number}"


@pytest.fixture
def stub(monkeypatch):
    """Return a list of actions of a command for tests, whose report has its flag."""
    actions = []

    def stub(number=0):
        """Test."""
        for action in actions:
            action()
        return Result(number)

    stub.__annotations__["number"] = Annotated[int, Field(high=255), flag("A number.")]
    monkeypatch.setitem(COMMANDS, "stub", CommandFunction(stub, {}))
    monkeypatch.setitem(cli.SUMMARIES, "stub", "Test.")
    return actions


def raises(failure):
    """Return a function that raises ``failure``."""

    def action():
        raise failure

    return action


def test_the_overview_lists_every_command(batchpid):
    status, out, _ = batchpid("--help")
    assert status == 0
    assert cli.SUMMARIES.keys() == COMMANDS.keys()
    text = " ".join(out.split())
    assert all(f" {name} {summary}" in text for name, summary in cli.SUMMARIES.items())


def test_a_missing_or_unknown_command_lists_those_there_are(batchpid):
    for arguments in ((), ("rolout",)):
        status, out, err = batchpid(*arguments)
        assert (status, out) == (2, "")
        assert all(name in err for name in COMMANDS)
    assert "did you mean 'rollout'?" in err


@pytest.mark.parametrize("value", ["", "1"])
def test_no_color_holds_in_help(value, batchpid, monkeypatch):
    monkeypatch.setenv("NO_COLOR", value)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    assert ("\x1b[" in batchpid("demo", "--help")[1]) == (not value)


def test_version(batchpid):
    assert batchpid("--version") == (0, f"{version}\n", "")


@pytest.mark.parametrize("name", list(COMMANDS))
def test_the_help_has_the_docstring_and_every_flag_with_its_help(name, batchpid):
    status, out, _ = batchpid(name, "--help")
    assert status == 0
    words = "".join(out.replace("│", "").split())
    assert "".join(COMMANDS[name].record().__doc__.split()) in words
    for field in dataclasses.fields(COMMANDS[name].record()):
        assert field.name.replace("_", "-") in out or field.name.upper() in out
        (text,) = (note.help for note in get_args(field.type) if hasattr(note, "help"))
        assert "".join(text.split()) in words


def test_a_base_is_free_or_fixed_by_a_flag(batchpid):
    for base, ground in (("free", "Ground at height 0."), ("fixed", "No ground: ")):
        assert ground in batchpid("inspect", "quadruped", "--base", base)[1]


def test_flags_reach_the_command_and_its_report_is_printed(batchpid, stub):
    assert batchpid("stub", "--number", "7")[:2] == (0, "done 7\n")
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
def test_failures_are_one_line_and_a_status(batchpid, stub, failure, status, message):
    stub.append(raises(failure))
    got, _, err = batchpid("stub")
    assert got == status
    assert err.startswith("batchpid: ")
    assert message in err
    assert err.count("\n") == 1


def test_the_variable_that_hinders_mujoco_is_named():
    done = subprocess.run(
        [sys.executable, "-m", "batchpid", "inspect", "panda"],
        env=os.environ | {"MUJOCO_GL": "nothing"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2
    assert re.fullmatch("batchpid: .*MUJOCO_GL='nothing'.*; unset MUJOCO_GL.*\n", done.stderr)


def test_a_bug_keeps_its_traceback(stub):
    stub.append(raises(ZeroDivisionError()))
    with pytest.raises(ZeroDivisionError):
        cli.main(["stub"])


def test_warnings_are_one_line(batchpid, stub):
    def action():
        warnings.simplefilter("always")
        warnings.warn("joint 4 cannot reach 1", UserWarning, stacklevel=1)

    stub.append(action)
    before = warnings.showwarning
    assert batchpid("stub") == (0, "done 0\n", "batchpid: warning: joint 4 cannot reach 1\n")
    assert warnings.showwarning is before


def test_help_loads_nothing_heavy():
    """One process asks for the help of all: what one loads stays loaded, and names it."""
    code = """
import sys
from batchpid.sim.cli import SUMMARIES, main

for words in (["--help"], *([name, "--help"] for name in SUMMARIES)):
    main(words)
    heavy = {"jax", "sapien", "matplotlib", "h5py"} & set(sys.modules)
    assert not heavy, (words, heavy)
"""
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)


def test_a_reader_that_ends_is_a_status_without_a_line(tmp_path):
    line = f"{sys.executable} -m batchpid inspect panda | head -c 1; exit ${{PIPESTATUS[0]}}"
    ran = subprocess.run(["bash", "-c", line], cwd=tmp_path, capture_output=True, text=True)
    assert ran.returncode in (0, 141)
    assert ran.stderr == ""


@pytest.mark.parametrize("seconds", [0.0, 3.0])
def test_ctrl_c_ends_a_command_in_one_line_and_its_processes(seconds, tmp_path):
    words = ["rollout", "--num-envs", "2", "--workers", "2", "--seconds", "1000"]
    process = subprocess.Popen(
        [sys.executable, "-m", "batchpid", *words],
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        cwd=tmp_path,
    )
    assert "panda: 9 dof" in process.stdout.readline().decode()  # the packages are imported
    time.sleep(seconds)
    family = psutil.Process(process.pid).children(recursive=True)
    process.send_signal(signal.SIGINT)
    error = process.communicate(timeout=PATIENCE)[1].decode()
    assert (process.returncode, error.splitlines()[-1]) == (130, "batchpid: interrupted")
    assert "Traceback" not in error
    assert have_ended([child.pid for child in family])
