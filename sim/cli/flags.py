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

PLAIN = (NoneType, bool, int, float, str, Path, Ellipsis)
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
ROBOT = (
    "Bundled robot (panda, jaco2 or quadruped), or path of a URDF or MJCF file. Default: panda, or"
    " the robot of a recording."
)
METAVARS = {
    "gains": "NAME|FILE",
    "engine": "sapien|mujoco",
    "control": None,
    "tool": "LINK",
    "ground": "on|off",
    "setpoint": "FLOAT [FLOAT ...]",
}
"""Words for the values of flags, where the type does not give them."""


def record_of(
    function: Callable[..., object],
    options: Sequence[str] = (),
    loading: Sequence[str] = (),
    outputs: Document | None = None,
) -> type:
    """Return a frozen dataclass whose fields are the flags of ``function``, for tyro.

    ``options`` are options of a Runner, and ``loading`` arguments of :meth:`Robot.load`, that have
    flags too; ``outputs`` are the output files with their help.
    """
    about, texts = sections(function)
    hints = get_type_hints(function, include_extras=True)
    rows = []
    for name, parameter in inspect.signature(function).parameters.items():
        # A parameter without a plain type, or without text, is an argument for Python alone.
        kind = _plain_part(hints[name])
        if Robot in (hints[name], *get_args(hints[name])):
            rows.append(_flag("robot", Annotated[str | None, tyro.conf.Positional], None, ROBOT))
        elif Randomization in get_args(hints[name]):
            rows.append(_flag("randomize", Path | None, None, texts[name]))
        elif kind is not None and name in texts:
            rows.append(_flag(name, kind, parameter.default, texts[name]))
    for name in options:
        kind = get_args(KINDS[name])[0]
        default = OPTIONS_WITH_FLAG[name]
        # A switch has three values: one that is left out is left to the Runner.
        if bool in get_args(kind):
            kind = Literal["on", "off"] | None
        rows.append(_flag(name, Annotated[kind, BOUNDS.get(name)], default, OPTIONS[name].flag))
    for name in loading:
        kind, text = LOADING[name]
        rows.append(_flag(name, kind, None, text))
    if outputs:
        rows += [_flag(name, Path | None, None, text) for name, text in outputs.items()]
        rows.append(_flag("force", bool, False, "Replace output files that exist."))
    # A field without a default stands first.
    rows.sort(key=lambda row: row[2].default is not MISSING)
    record = make_dataclass("Flags", rows, frozen=True)
    record.__doc__ = about
    return record


def sections(function: Callable[..., object]) -> tuple[str, dict[str, str]]:
    """Return the description in a function's docstring, and the text of each parameter."""
    about, _, rest = inspect.getdoc(function).partition("\n\nParameters\n")  # type: ignore[union-attr]
    parameters = re.split("\n\n(?:Raises|Returns)\n", rest)[0]
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


def _flag(
    name: str,
    kind: Kind,
    default: Any,
    text: str,
) -> tuple[str, Any, Any]:
    """Return a field of a dataclass; its help leaves out the defaults None, False, True and ()."""

    def hint(default: str) -> str:
        if default in ("None", "False", "True", ""):
            return ""
        return f"(default: {default})"

    options: Document = {}
    if name in METAVARS:
        options["metavar"] = METAVARS[name]
    if default is None and Path in get_args(kind):
        options["metavar"] = "FILE"
    setting = tyro.conf.arg(help=text, help_behavior_hint=hint, **options)
    described = Annotated[kind, setting]  # type: ignore[valid-type]
    if default is inspect.Parameter.empty:
        return name, described, field()
    return name, described, field(default=default)


def _plain_part(kind: Kind) -> Any:
    """Return the part of a type that has plain values; None if it has none besides None."""
    # A union may have members for Python beside those for the command line.
    if get_origin(kind) in (Union, UnionType):
        kind = Union[tuple(filter(_is_plain, get_args(kind)))]  # noqa: UP007
    if kind is NoneType or not _is_plain(kind):
        return None
    return kind


def _is_plain(kind: Kind) -> bool:
    """Return whether all values of a type can be written on the command line."""
    if get_origin(kind) is Annotated:
        return _is_plain(get_args(kind)[0])
    if get_origin(kind) is Literal or kind in PLAIN:
        return True
    return bool(get_args(kind)) and all(map(_is_plain, get_args(kind)))


def _words(text: str) -> str:
    """Return a docstring's text without its marks of references and code, a line a paragraph."""
    # A terminal shows neither references nor code.
    text = re.sub(r":\w+:`~?([^`]*)`|``", r"\1", text)
    return "\n\n".join(" ".join(part.split()) for part in text.split("\n\n"))
