"""Flags of all commands, from their parsers: one name has one meaning, and a mistake is answered by
the command.
"""

import warnings
from collections import defaultdict
from functools import cache
from pathlib import Path

import pytest
import tyro
from commands_that_write import WORDS

from batchpid.sim.cli.commands import COMMANDS

SEVERAL = {("compare", "--gains"), ("compare", "--engine")}
"""Flags that take several values in one command, and one in the others."""


@cache
def actions(command):
    """Return the declared arguments of a command."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        parser = tyro.extras.get_parser(
            COMMANDS[command].record(), config=(tyro.conf.FlagCreatePairsOff,)
        )
    return parser._actions


def flags(command):
    """Return the flags of a command, with the kind of value that each takes."""
    return {
        name: str(action.metavar) for action in actions(command) for name in action.option_strings
    }


def choices(command):
    """Return the flags of a command that take one of several words."""
    return {name for action in actions(command) if action.choices for name in action.option_strings}


def test_there_are_few_flags():
    assert sum(len(flags(command).keys() - {"-h", "--help"}) for command in COMMANDS) <= 68


def test_a_flag_takes_one_kind_of_value():
    kinds = defaultdict(set)
    for command in COMMANDS:
        for flag, kind in flags(command).items():
            if (command, flag) not in SEVERAL:
                kinds[flag].add(kind.replace("{None}|", "").replace("None,", ""))
    assert not {flag: seen for flag, seen in kinds.items() if len(seen) > 1}


@pytest.mark.parametrize("command", COMMANDS)
def test_a_wrong_flag_is_answered_with_the_help_of_its_command(command, batchpid):
    status, said, complaint = batchpid(command, *WORDS.get(command, (command,))[1:], "--wrong-flag")
    assert (status, said) == (2, "")
    assert "--wrong-flag" in complaint
    assert f"batchpid {command} --help" in complaint
    assert not [
        other for other in COMMANDS if other != command and f"batchpid {other} " in complaint
    ]


BAD = {
    "INT": ("-1",),
    "FLOAT": ("nan", "-1"),
    "FLOAT [FLOAT ...]": ("nan",),
    "FILE": ("nothing.xyz",),
    "PATH": ("nothing.xyz",),
    "LINK": ("nothing",),
    "NAME": ("nothing",),
    "NAME|FILE": ("nothing",),
}
"""Bad values of a flag, by the kind of value that it takes. Any text is good for the other
kinds.
"""
SHORT = {
    "demo": ("demo", "--num-envs", 1, "--seconds", 0.02),
    "rollout": ("rollout", "arm.urdf", "--num-envs", 1, "--workers", 0, "--seconds", 0.02),
    "identify": (*WORDS["identify"], "--gains", "designed"),
    "inspect": ("inspect", "arm.urdf"),
    "view": ("view", "arm.urdf", "--num-envs", 1, "--workers", 0, "--time-limit", 0.1),
}
"""Words of commands, where they are other ones than in WORDS."""


def bad_values(command):
    """Return each flag of a command with a bad value; the command names the flag."""
    found = []
    for flag, kind in flags(command).items():
        kind = kind.replace("{None}|", "")
        found += [
            (command, flag, bad)
            for bad in (("other",) if flag in choices(command) else BAD.get(kind, ()))
        ]
    return found


@pytest.mark.parametrize(
    ("command", "flag", "bad"), [row for command in COMMANDS for row in bad_values(command)]
)
def test_a_bad_value_is_answered_by_the_name_of_its_flag(
    command,
    flag,
    bad,
    files,
    batchpid,
    monkeypatch,
):
    monkeypatch.chdir(files)
    before = written(files)
    status, _, complaint = batchpid(*(WORDS | SHORT)[command], flag, bad)
    assert status == 2
    assert flag.strip("-").replace("-", "_") in complaint.replace("-", "_") or bad in complaint
    assert written(files) == before


def written(folder):
    """Return the files and folders below a folder."""
    return {*folder.rglob("*")}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("demo pander", "no robot 'pander'"),
        ("demo --picture demo.jpg", "picture: unknown file format"),
        ("rollout --setpoint 1 2", "setpoint: has shape (2,)"),
        ("rollout --out a.npz", "out: unknown file format"),
        ("rollout --gains tunned", "use tuned, designed, "),
        ("identify arm.urdf", "logs: are missing"),
        ("export panda --gains drive", "gains: belong to a drive"),
        ("inspect panda2", "'panda2'"),
        ("plot /dev/null", "/dev/null"),
        ("plot .", "."),
        ("view --port 99999", "port: out of range (got 99999)"),
    ],
)
def test_flags_that_contradict_each_other_are_answered_in_one_line(
    words,
    message,
    files,
    batchpid,
    monkeypatch,
):
    monkeypatch.chdir(files)
    before = written(Path())
    status, said, complaint = batchpid(*words.split())
    assert written(Path()) == before
    assert (status, complaint.count("\n")) == (2, 1)
    assert said.count("\n") <= 1  # the first line
    assert complaint.startswith("batchpid: ")
    assert message in complaint


def test_no_default_output_needs_a_folder_of_the_user(batchpid):
    assert batchpid("excite", "panda", "--seconds", 1)[0] == 0
    assert [path.name for path in Path("out").iterdir()] == ["panda.excite.csv"]
