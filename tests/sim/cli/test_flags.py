"""Flags of all commands, from their parsers: one name has one meaning, and a mistake is answered by the command."""

from __future__ import annotations

import io
import warnings
from functools import cache
from pathlib import Path

import pytest
import tyro
from test_outputs import OUT, SUFFIXES, WORDS, files, output_flags  # noqa: F401

from batchpid.sim.cli import COMMANDS
from batchpid.sim.cli.outputs import bar, waiting

RUNS_ROBOTS = {"demo", "rollout", "tune", "compare", "view"}
HAVE = {
    "--gains": {"demo", "rollout", "compare", "identify", "export", "inspect", "parity", "view"},
    "--seconds": {"demo", "rollout", "tune", "compare", "excite", "parity", "survey"},
    "--engine": RUNS_ROBOTS | {"inspect", "survey"},
    "--ground": RUNS_ROBOTS,
    "--spread": {"demo", "rollout", "view"},
    "--json": {"demo", "rollout", "compare", "identify", "inspect", "parity", "survey"},
    "--out": {"rollout", "tune", "excite", "identify", "export", "survey", "render"},
    "--picture": {"demo", "rollout", "tune", "compare", "identify", "parity", "plot"},
    "--package-dirs": COMMANDS.keys() - {"plot"},
    "--missing-meshes": COMMANDS.keys() - {"plot"},
    "--resume": {"rollout", "tune", "identify"},
}
"""Commands in which a flag has a meaning."""
SEVERAL = {("compare", "--gains"), ("compare", "--engine")}
"""Flags that take several values in one command, and one in the others."""


@cache
def flags(command: str) -> dict[str, str]:
    """Return the flags of a command, with the kind of value that each takes."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        parser = tyro.extras.get_parser(COMMANDS[command], config=(tyro.conf.FlagCreatePairsOff,))
    return {name: str(action.metavar) for action in parser._actions for name in action.option_strings}


@pytest.mark.parametrize("flag", HAVE)
def test_a_flag_is_in_every_command_where_it_has_a_meaning_and_takes_one_kind_of_value(flag):
    have = {command for command in COMMANDS if flag in flags(command)}
    assert have == HAVE[flag]
    kinds = {flags(command)[flag] for command in have if (command, flag) not in SEVERAL}
    kinds = {kind.replace("{None}|", "").replace("{sapien,mujoco}", "NAME") for kind in kinds}
    assert len(kinds) == 1, kinds


@pytest.mark.parametrize("command", COMMANDS)
def test_a_wrong_flag_is_answered_with_the_help_of_its_command(command, batchpid):
    status, said, complaint = batchpid(command, *WORDS.get(command, (command,))[1:], "--wrong-flag")
    assert (status, said) == (2, "")
    assert "--wrong-flag" in complaint
    assert f"batchpid {command} --help" in complaint
    assert not [other for other in COMMANDS if other != command and f"batchpid {other} " in complaint]


@pytest.mark.parametrize(("command", "flag"), output_flags())
def test_an_output_without_a_folder_is_refused_before_the_run(command, flag, files, batchpid, tmp_path, monkeypatch):  # noqa: F811
    monkeypatch.chdir(files)
    path = tmp_path / "missing" / f"a{OUT.get(command, SUFFIXES[flag]) if flag == 'out' else SUFFIXES[flag]}"
    status, said, complaint = batchpid(*WORDS[command], f"--{flag}", path)
    assert (status, said) == (2, "")
    assert complaint.splitlines()[-1].endswith(f"mkdir -p {path.parent}")
    assert not path.parent.exists()


@pytest.mark.parametrize("command", sorted(HAVE["--gains"] - {"identify"}))
def test_misspelled_gains_are_answered_with_the_nearest_name(command, batchpid):
    status, _, complaint = batchpid(command, "panda", "--gains", "tunned")
    assert status == 2
    assert "gains: is neither a name nor a file (got 'tunned'); did you mean 'tuned'?" in complaint


def test_former_names_of_flags_work():
    from batchpid.sim.cli import parse

    assert parse(["tune", "--search-seconds", "0.5"]) == parse(["tune", "--seconds", "0.5"])
    assert parse(["excite", "--duration", "3"]) == parse(["excite", "--seconds", "3"])
    assert parse(["identify", "--params", "a.yaml"]) == parse(["identify", "--gains", "a.yaml"])


class Terminal(io.StringIO):
    """A stderr that may be a terminal."""

    def __init__(self, is_terminal):
        super().__init__()
        self.is_terminal = is_terminal

    def isatty(self):
        return self.is_terminal


@pytest.mark.parametrize("is_terminal", [False, True])
def test_bars_are_for_terminals_alone(is_terminal, monkeypatch):
    monkeypatch.setattr("sys.stderr", Terminal(is_terminal))
    with waiting("building", delay=0.0):
        shown = bar("working", delay=0.0, mininterval=0.0)
        assert list(shown(range(3))) == [0, 1, 2]
    import sys

    written = sys.stderr.getvalue()
    assert ("working" in written) == ("building" in written) == is_terminal


def test_no_default_output_needs_a_folder_of_the_user(batchpid):
    assert batchpid("excite", "panda", "--seconds", 1, "--rate", 100)[0] == 0
    assert [path.name for path in Path("out").iterdir()] == ["panda.excite.csv"]
