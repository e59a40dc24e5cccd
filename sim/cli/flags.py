"""Flags of a command, made from the signature and the docstring of its function.

A parameter becomes a flag where its type has plain values (numbers, text, paths, words), and its
section in the docstring is the help. A robot becomes a positional name or file, with the flags of
:data:`LOADING`; a randomization becomes ``--randomize FILE``. Other parameters are for Python.
"""

from __future__ import annotations

import inspect
import re
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import MISSING, field, fields, make_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import tyro

from batchpid.arrays.array_types import Document, Kind
from batchpid.arrays.field_tables import Field, declared, plain
from batchpid.sim.options.options import KINDS, OPTIONS, RunnerKeywords
from batchpid.sim.randomization.randomization import Randomization
from batchpid.sim.robot.robot import Robot

PLAIN = (NoneType, bool, int, float, str, Path)
OPTIONS_WITH_FLAG = {
    entry.name: entry.default for entry in fields(RunnerKeywords) if OPTIONS[entry.name].flag
}
"""Options of a Runner that have a flag, with their defaults."""
BOUNDS = declared(RunnerKeywords, Field)
"""Ranges of the options that are numbers."""
LOADING = {
    "base": (
        Literal["free", "fixed"] | None,
        "Base of the robot: free to move, or fixed to the world. Default: as the file says.",
    ),
    "actuators": (
        Path | None,
        "Motors and sensors: a file (.yaml or .json) of batchpid.save_actuators. Default: ideal"
        " ones. Drives take their friction and armature alone.",
    ),
}
"""Arguments of :meth:`Robot.load` that are flags, with their types and help."""
ROBOT = "Bundled robot (panda, jaco2 or quadruped), or path of a URDF or MJCF file."
METAVARS = {
    "gains": "NAME|FILE",
    "control": None,
    "tool": "LINK",
    "ground": "on|off",
    "joints": "NAME [NAME ...]",
    "setpoint": "FLOAT [FLOAT ...]",
}
"""Words for the values of flags, where the type does not give them."""


def record_of(
    function: Callable[..., Any],
    options: Sequence[str] = (),
    loading: Sequence[str] = (),
    outputs: Document | None = None,
) -> type[Any]:
    """Return a frozen dataclass whose fields are the flags of ``function``, for tyro.

    ``options`` are options of a Runner, and ``loading`` arguments of :meth:`Robot.load`, that have
    flags too; ``outputs`` are the output files with their help.
    """
    about, texts = sections(function)
    hints = get_type_hints(function, include_extras=True)
    rows = []
    for name, parameter in inspect.signature(function).parameters.items():
        # What has no plain type, or no text, is an argument for Python alone.
        kind = _plain_part(hints[name])
        default = parameter.default
        if Robot in (hints[name], *get_args(hints[name])):
            # A recording has a robot already.
            name_or_none = default is None
            word: Kind = str | None if name_or_none else str
            word = Annotated[word, tyro.conf.Positional]
            rows.append(_flag("robot", word, None if name_or_none else "panda", ROBOT))
        elif Randomization in get_args(hints[name]):
            rows.append(_flag("randomize", Path | None, None, texts[name]))
        elif kind is not None and name in texts:
            rows.append(_flag(name, kind, default, texts[name]))
    for name in options:
        kind = _plain_part(get_args(KINDS[name])[0])
        default = OPTIONS_WITH_FLAG[name]
        # A switch that is left out is left to the Runner: three values.
        if default is None and bool in get_args(kind):
            kind = Literal["on", "off"] | None
        rows.append(_flag(name, Annotated[kind, BOUNDS.get(name)], default, OPTIONS[name].flag))
    rows += [_flag(name, LOADING[name][0], None, LOADING[name][1]) for name in loading]
    for name, text in (outputs or {}).items():
        rows.append(_flag(name, Path | None, None, text))
    if outputs:
        rows.append(_flag("force", bool, False, "Replace output files that exist."))
    # A field without a default stands first.
    rows.sort(key=lambda row: row[2].default is not MISSING)
    record = make_dataclass("Flags", rows, frozen=True)
    record.__doc__ = about
    return record


def sections(function: Callable[..., Any]) -> tuple[str, dict[str, str]]:
    """Return the description in a function's docstring, and the text of each parameter."""
    about, _, rest = inspect.getdoc(function).partition("\n\nParameters\n")  # type: ignore[union-attr]
    parameters = rest.partition("\n\nRaises\n")[0].partition("\n\nReturns\n")[0]
    texts = {}
    for names, text in re.findall(r"^(\w[\w, ]*)\n((?:    .*\n?|\n)+)", parameters, re.MULTILINE):
        for name in names.split(", "):
            texts[name] = _words(textwrap.dedent(text).strip())
    return _words(about), texts


def check(record: Any) -> None:
    """Check flags by their ranges. InvalidArgumentError names the first bad one.

    Types and words are tyro's task, and numbers without a range that of the function.
    """
    for entry in fields(record):
        if any(isinstance(note, Field) for note in get_args(entry.type)):
            plain(entry.name, entry.type, getattr(record, entry.name))


def _flag(name: str, kind: Kind, default: Any, text: str) -> tuple[str, Any, Any]:
    """Return a field of a dataclass; its help leaves out the defaults None, False, True and ()."""

    def hint(default: str) -> str:
        if default in ("None", "False", "True", ""):
            return ""
        return f"(default: {default})"

    if name in METAVARS:
        options = {"metavar": METAVARS[name]}
    else:
        options = {}
    if default is None and Path in get_args(kind):
        options = {"metavar": "FILE"}
    described = Annotated[kind, tyro.conf.arg(help=text, help_behavior_hint=hint, **options)]
    if default is inspect.Parameter.empty:
        made = field()
    else:
        made = field(default=default)
    return name, described, made


def _plain_part(kind: Kind) -> Any:
    """Return the part of a type that has plain values; None if it has none besides None."""
    # Ranges and marks for tyro stay with the type.
    if get_origin(kind) is Annotated:
        inner, *notes = get_args(kind)
        part = _plain_part(inner)
        if part is None:
            return None
        return Annotated[(part, *notes)]
    if get_origin(kind) in (Union, UnionType):
        members = [member for member in get_args(kind) if _plain_part(member) or member is NoneType]
        return None if members in ([], [NoneType]) else Union[tuple(members)]  # noqa: UP007
    if get_origin(kind) is tuple:
        if get_args(kind)[0] in PLAIN or _plain_part(get_args(kind)[0]):
            return kind
        return None
    if (kind in PLAIN and kind is not NoneType) or get_origin(kind) is Literal:
        return kind
    return None


def _words(text: str) -> str:
    """Return a docstring's text without its marks of references and code, a line a paragraph."""
    # A terminal shows neither references nor code.
    text = re.sub(r":\w+:`~?([^`]*)`|``", r"\1", text)
    return "\n\n".join(" ".join(part.split()) for part in text.split("\n\n"))
