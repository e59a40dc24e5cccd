"""Flags of a command, made from the annotations of its function.

A parameter with :func:`flag` in its annotation is a flag; its type, range and help stand there. A
robot is a positional name or file, with the flags of :data:`LOADING`. Other parameters are for
Python.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, make_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_type_hints

import tyro

from batchpid.arrays.field_tables import Field, declared, plain
from batchpid.sim.options.groups import EngineName
from batchpid.sim.options.options import OPTIONS, RunnerKeywords
from batchpid.sim.robot.robot import Robot


def flag(text: str, metavar: str | None = None) -> Any:
    """Return the part of an annotation that makes a parameter a flag: its help, and a word for its
    values where the type gives none.
    """
    return tyro.conf.arg(
        help=text,
        metavar=metavar,
        help_behavior_hint=_hint,
    )


def _hint(default: str) -> str:
    """Return the end of a flag's help; the help itself describes the defaults left out here."""
    if default in ("None", "False", "True", ""):
        return ""
    return f"(default: {default})"


BOUNDS = declared(RunnerKeywords, Field)
"""Ranges of the options that are numbers."""
NumEnvs = Annotated[int, BOUNDS["num_envs"], flag("Number of robots, one in each scene.")]
GAINS_FLAG = flag(
    "Gains: tuned, designed, sapien-tutorial, mjcf, drive, or a params file (.yaml) that `batchpid"
    " tune` or batchpid.save_params wrote. Default: tuned where the robot has them, else designed.",
    "NAME|FILE",
)
Gains = Annotated[str | None, GAINS_FLAG]
Engine = Annotated[EngineName, flag(OPTIONS["engine"].flag)]
Workers = Annotated[int | None, BOUNDS["workers"], flag(OPTIONS["workers"].flag)]
Randomize = Annotated[
    Path | None,
    flag(
        "Draw the robot of each env: a YAML file (docs/randomization.md), e.g. `payload: {uniform:"
        " [0, 0.5]}`.",
        "FILE",
    ),
]
ROBOT = Annotated[
    str | None,
    tyro.conf.Positional,
    flag(
        "Bundled robot (panda, jaco2 or quadruped), or path of a URDF or MJCF file. Default: panda,"
        " or the robot of a recording."
    ),
]
LOADING = {
    "base": Annotated[
        Literal["free", "fixed"] | None,
        flag("Base of the robot: free to move, or fixed to the world. Default: as the file says."),
    ],
    "actuators": Annotated[
        Path | None,
        flag(
            "Motors and sensors: a file (.yaml) of batchpid.save_actuators. Default: ideal"
            " ones. Drives take their friction and armature alone.",
            "FILE",
        ),
    ],
}
"""Arguments of :meth:`Robot.load` that are flags."""


def record_of(
    function: Callable[..., object], loading: Sequence[str], outputs: Mapping[str, str]
) -> type:
    """Return a frozen dataclass whose fields are the flags of ``function``, for tyro.

    ``loading`` are arguments of :meth:`Robot.load` that have flags too; ``outputs`` are the output
    files with their help.
    """
    hints = get_type_hints(function, include_extras=True)
    rows: list[tuple[str, Any, Any]] = []
    for name, parameter in inspect.signature(function).parameters.items():
        kind = hints[name]
        notes = get_args(kind)
        if Robot in (kind, *notes):
            rows.append(("robot", ROBOT, None))
        elif any(isinstance(note, type(GAINS_FLAG)) for note in notes):
            rows.append((name, kind, parameter.default))
    rows += [(name, LOADING[name], None) for name in loading]
    rows += [
        (name, Annotated[Path | None, flag(text, "FILE")], None) for name, text in outputs.items()
    ]
    if outputs:
        rows.append(("force", Annotated[bool, flag("Replace output files that exist.")], False))
    # A flag without a default stands first.
    rows.sort(key=lambda row: row[2] is not inspect.Parameter.empty)
    parts = [row[:2] if row[2] is inspect.Parameter.empty else row for row in rows]
    record = make_dataclass("Flags", parts, frozen=True)
    record.__doc__ = (inspect.getdoc(function) or "").replace("``", "`")
    return record


def check(record: Any) -> None:
    """Check flags by their ranges. InvalidArgumentError names the first bad one.

    Types and words are tyro's task, and numbers without a range that of the function.
    """
    for entry in fields(record):
        if any(isinstance(note, Field) for note in get_args(entry.type)):
            plain(entry.name, entry.type, getattr(record, entry.name))
