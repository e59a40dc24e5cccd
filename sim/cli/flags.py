"""Flags that several commands share: one name, one meaning and one help text each."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, fields, is_dataclass, make_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import tyro

from batchpid.arrays.array_types import Document, Kind
from batchpid.arrays.field_tables import Field, declared, plain
from batchpid.errors import InvalidArgumentError
from batchpid.sim.options.groups import Compensation, EngineName, PhysicsPreset
from batchpid.sim.options.options import KINDS, OPTIONS, RunnerKeywords


def _flag(help: str | None = None, **options: Any) -> Any:
    """Return tyro's options of a flag; its help leaves out the defaults None, False, True and
    ().
    """

    def hint(default: str) -> str:
        return "" if default in ("None", "False", "True", "") else f"(default: {default})"

    return tyro.conf.arg(help=help, help_behavior_hint=hint, **options)


def check(command: Any) -> None:
    """Check the flags of a command, and of its groups of flags, by their types and the Field in
    their annotations.

    Raises InvalidArgumentError for the first value that is out of range.
    """
    for name, kind in get_type_hints(type(command), include_extras=True).items():
        value = getattr(command, name)
        if is_dataclass(value):
            check(value)
        else:
            plain(name, kind, value)


def chosen(command: Any, names: str) -> Document:
    """Return the values of some flags of a command, as arguments of the same names, which are
    separated by blanks.
    """
    return {name: getattr(command, name) for name in names.split()}


def refuse(command: Any, names: Iterable[str], problem: str) -> None:
    """Raise InvalidArgumentError for the first flag among ``names`` that is not at its default."""
    defaults = {entry.name: entry.default for entry in fields(command)}
    for name in names:
        if (value := getattr(command, name)) != defaults[name]:
            raise InvalidArgumentError(name, problem, value=value, remedy="leave it out")


FLAGS = {entry.name: entry.default for entry in fields(RunnerKeywords) if OPTIONS[entry.name].flag}
"""Options that have a flag, with their defaults."""
SCENE_FLAGS = tuple(name for name in FLAGS if "scene" in OPTIONS[name].kept and name != "engine")
"""Options that change the scenes in an engine."""
BOUNDS = declared(RunnerKeywords, Field)
"""Ranges of the options that are numbers."""
_PLAIN = (NoneType, bool, int, float, str)
_SWITCHES = [name for name, kind in KINDS.items() if get_args(kind)[0] == bool | None]
"""Options that are on, off, or chosen by the Runner."""


def of_option(name: str) -> Any:
    """Return tyro's options of the flag of a Runner's option."""
    return _flag(OPTIONS[name].flag, metavar="on|off" if name in _SWITCHES else None)


def _kind(name: str) -> Kind:
    """Return the type of the flag of a Runner's option: the part of its declared type that has
    plain values.
    """
    kind = Literal["on", "off"] | None if name in _SWITCHES else get_args(KINDS[name])[0]
    if get_origin(kind) not in (Union, UnionType):
        return kind
    return Union[  # noqa: UP007
        tuple(
            option for option in get_args(kind) if option in _PLAIN or get_origin(option) is Literal
        )
    ]


@dataclass(frozen=True)
class RunnerFlags:
    """Flags that are options of a Runner, by :func:`runner_flags`."""

    def options(self) -> Document:
        """Return the options as arguments of a Runner; switches that are left out are left to
        it.
        """
        values = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        switches = {name: values.pop(name) for name in _SWITCHES if name in values}
        return values | {
            name: value == "on" for name, value in switches.items() if value is not None
        }


def runner_flags(*names: str) -> type[RunnerFlags]:
    """Return the flags of a Runner's options, by default of all that have one."""
    chosen = names or FLAGS
    kinds = {name: Annotated[_kind(name), BOUNDS.get(name), of_option(name)] for name in chosen}
    made = [(name, kind, field(default=FLAGS[name])) for name, kind in kinds.items()]
    return make_dataclass("ChosenFlags", made, bases=(RunnerFlags,), frozen=True)


def group(made: type[RunnerFlags]) -> Any:
    """Return tyro's options of a field that holds the flags of :func:`runner_flags`."""
    return tyro.conf.arg(name="", constructor=made)


OptionalPath = Annotated[Path | None, _flag()]
OptionalName = Annotated[str | None, _flag(metavar="NAME")]
OptionalFloats = Annotated[tuple[float, ...] | None, _flag(metavar="FLOAT [FLOAT ...]")]
Switch = Annotated[bool, _flag()]
Force = Annotated[bool, _flag("Replace output files that exist.")]

RobotName = Annotated[
    str,
    tyro.conf.Positional,
    _flag("Bundled robot (panda or jaco2), or path of a URDF or MJCF file."),
]
RecordedRobot = Annotated[
    str | None,
    tyro.conf.Positional,
    _flag(
        "Bundled robot, or path of a URDF or MJCF file. Default: that of the recording, or panda."
    ),
]


@dataclass(frozen=True)
class MeshOptions:
    """Flags of every command that loads a robot, as arguments of ``Robot.load``."""

    missing_meshes: Annotated[
        Literal["error", "skip"], _flag("Skip collision shapes whose mesh is missing, or raise.")
    ] = "skip"
    package_dirs: Annotated[
        tuple[Path, ...],
        _flag(
            "Folders that hold the packages of package:// mesh paths, looked up first.",
            metavar="FOLDER [FOLDER ...]",
        ),
    ] = ()


Meshes = Annotated[MeshOptions, tyro.conf.arg(name="")]
NumEnvs = Annotated[int, BOUNDS["num_envs"], _flag("Number of robots, one in each scene.")]
Workers = Annotated[int | None, BOUNDS["workers"], of_option("workers")]
Cluster = Annotated[Literal["ray"] | None, of_option("cluster")]
Gains = Annotated[
    str | None,
    _flag(
        "Gains: tuned, designed, tutorial, mjcf, drive:STIFFNESS,DAMPING, or a params file (.yaml"
        " or .json) that `batchpid tune` or batchpid.save_params wrote, or an MJCF file (.xml)."
        " Default: tuned where the robot has them, else designed.",
        metavar="NAME|FILE",
    ),
]
Actuators = Annotated[
    Path | None,
    _flag(
        "Motors and sensors: a file (.yaml or .json) of batchpid.save_actuators. Default: ideal"
        " ones. Of these, drives have the friction and armature alone.",
        metavar="FILE",
    ),
]
GainSets = Annotated[
    tuple[str, ...],
    _flag(
        "Sets of gains: tuned, designed, tutorial, mjcf, drive, drive:STIFFNESS,DAMPING, params"
        " files (.yaml or .json) that `batchpid tune` or batchpid.save_params wrote, or MJCF files"
        " (.xml). Default: tuned, tutorial and drive for a bundled robot, else designed and drive.",
        metavar="NAME|FILE [NAME|FILE ...]",
    ),
]
Engine = Annotated[EngineName, of_option("engine")]
Engines = Annotated[tuple[EngineName, ...], _flag("Physics engines, one or both.")]
Physics = Annotated[PhysicsPreset, of_option("physics")]
Compensate = Annotated[Compensation, of_option("compensate")]
Seed = Annotated[int, Field(high=2**31 - 1)]
Seconds = Annotated[
    float, Field("simulated time, s", low=1e-6, high=1e6), _flag("Simulated time [s].")
]
MoveSeconds = Annotated[float, Field("simulated time, s", low=0.05, high=600.0)]
Distance = Annotated[float, Field("rad or m", high=10.0)]
Spread = Annotated[
    Distance, _flag("Largest distance of a start pose from that of env 0 [rad or m].")
]
Json = Annotated[Path | None, _flag("Figures to write: .json.", metavar="FILE")]
ShownEnvs = Annotated[int, Field(low=1, high=64)]
Fps = Annotated[float, Field("frames per second", low=1.0, high=120.0), _flag("Frames per second.")]
TimeLimit = Annotated[
    float | None, Field("s"), _flag("Stop after this wall-clock time [s]. Default: none.")
]
Randomize = Annotated[
    str | None,
    _flag(
        "Draw the robot of each move or env: a YAML file (docs/randomization.md), e.g. `payload:"
        " {uniform: [0, 0.5]}`.",
        metavar="FILE",
    ),
]
