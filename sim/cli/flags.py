"""Flags that several commands share: one name, one meaning and one help text each."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from batchpid.arrays.array_types import Document
from batchpid.errors import InvalidArgumentError


def _flag(help: str | None = None, **options: Any) -> Any:
    """Return tyro's options of a flag; its help leaves out the defaults None, False, True and ()."""

    def hint(default: str) -> str:
        return "" if default in ("None", "False", "True", "") else f"(default: {default})"

    return tyro.conf.arg(help=help, help_behavior_hint=hint, **options)


def chosen(command: Any, names: str) -> Document:
    """Return the values of some flags of a command, as arguments of the same names, which are separated by blanks."""
    values = {name: getattr(command, name) for name in names.split()}
    if "ground" in values and (ground := values.pop("ground")) is not None:
        values["ground"] = ground == "on"
    return values


def refuse(command: Any, names: Iterable[str], problem: str) -> None:
    """Raise InvalidArgumentError for the first flag among ``names`` that is not at its default."""
    defaults = {each.name: each.default for each in fields(command)}
    for name in names:
        if (value := getattr(command, name)) != defaults[name]:
            raise InvalidArgumentError(name, problem, value=value, remedy="leave it out")


OptionalPath = Annotated[Path | None, _flag()]
OptionalName = Annotated[str | None, _flag(metavar="NAME")]
OptionalFloats = Annotated[tuple[float, ...] | None, _flag(metavar="FLOAT [FLOAT ...]")]
Switch = Annotated[bool, _flag()]
Force = Annotated[bool, _flag("Replace output files that exist.")]

RobotName = Annotated[
    str, tyro.conf.Positional, _flag("Bundled robot (panda or jaco2), or path of a URDF or MJCF file.")
]
RecordedRobot = Annotated[
    str | None,
    tyro.conf.Positional,
    _flag("Bundled robot, or path of a URDF or MJCF file. Default: that of the recording, or panda."),
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
            "Folders that hold the packages of package:// mesh paths, looked up first.", metavar="FOLDER [FOLDER ...]"
        ),
    ] = ()


Meshes = Annotated[MeshOptions, tyro.conf.arg(name="")]
NumEnvs = Annotated[int, _flag("Number of robots, one in each scene.")]
Workers = Annotated[int | None, _flag("Processes that step the scenes; 0: this one. Default: one per available core.")]
Cluster = Annotated[
    Literal["ray"] | None,
    _flag("Run on a Ray cluster: that of RAY_ADDRESS, else of this machine (extra `ray`; docs/cluster.md)."),
]
Gains = Annotated[
    str | None,
    _flag(
        "Gains: tuned, designed, tutorial, mjcf, drive:STIFFNESS,DAMPING, or a params file (.yaml or .json) that "
        "`batchpid tune` or batchpid.save_params wrote, or gains of ros2_control (.yaml), Isaac Lab (.py) or MuJoCo "
        "(.xml). Default: tuned where the robot has them, else designed. With --control osc: a file of `batchpid tune "
        "--control osc`.",
        metavar="NAME|FILE",
    ),
]
Actuators = Annotated[
    Path | None,
    _flag(
        "Motors and sensors: a file (.yaml or .json) of batchpid.save_actuators. Default: ideal ones. Of these, drives "
        "have the friction and armature alone.",
        metavar="FILE",
    ),
]
GainSets = Annotated[
    tuple[str, ...],
    _flag(
        "Sets of gains: tuned, designed, tutorial, mjcf, drive, drive:STIFFNESS,DAMPING, or params files (.yaml or "
        ".json) that `batchpid tune` or batchpid.save_params wrote, or gains of ros2_control (.yaml), Isaac Lab (.py) "
        "or MuJoCo (.xml). Default: tuned, "
        "tutorial and drive for a bundled robot, else designed and drive.",
        metavar="NAME|FILE [NAME|FILE ...]",
    ),
]
Engine = Annotated[
    Literal["sapien", "mujoco"],
    _flag("Physics engine; mujoco is several times as fast, and its contacts differ."),
]
Engines = Annotated[
    tuple[Literal["sapien", "mujoco"], ...],
    _flag("Physics engines, one or both."),
]
Physics = Annotated[
    Literal["accurate", "fast", "free"],
    _flag("Solver settings: SAPIEN's, fewer iterations, or one, for motion without contact."),
]
Collisions = Annotated[bool, _flag("Robots have no collision shapes: faster, for free motion only.")]
Compensate = Annotated[
    Literal["gravity+coriolis+friction", "gravity+coriolis", "gravity", "none"],
    _flag("Passive force and known friction, added at every sim step."),
]
Backend = Annotated[Literal["numpy", "jax"], _flag("Library of the law: NumPy, or JAX, as one program with the steps.")]
Seconds = Annotated[float, _flag("Simulated time [s].")]
Ground = Annotated[
    Literal["on", "off"] | None,
    _flag(
        "Ground at height 0. Default: on, unless links of a fixed robot reach it at the start pose.", metavar="on|off"
    ),
]
Spread = Annotated[float, _flag("Largest distance of a start pose from that of env 0 [rad or m].")]
Json = Annotated[Path | None, _flag("Figures to write: .json.", metavar="FILE")]
Fps = Annotated[float, _flag("Frames per second.")]
TimeLimit = Annotated[float | None, _flag("Stop after this wall-clock time [s]. Default: none.")]
Randomize = Annotated[
    str | None,
    _flag(
        "Draw the robot of each move or env: payload, model, or a YAML file (docs/randomization.md), e.g. "
        "`payload: {uniform: [0, 0.5]}`.",
        metavar="NAME|FILE",
    ),
]
Variation = Annotated[bool, _flag("Draw payload, joint friction, sensor resolution and effort delay for each move.")]
Payload = Annotated[float, _flag("With --variation: largest payload [kg]; less where the robot cannot carry it.")]
Friction = Annotated[float, _flag("With --variation: largest Coulomb friction added to the joints [N m or N].")]
