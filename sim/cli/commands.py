"""Table of the commands, and the execution of one: inputs, outputs, report.

No file is replaced without ``--force``.
"""

from __future__ import annotations

import inspect
import os
import shlex
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from batchpid.arrays.array_types import Document, Progress
from batchpid.checks import file_path
from batchpid.errors import InvalidArgumentError
from batchpid.sim import Robot
from batchpid.sim.cli import flags
from batchpid.sim.cli.gains import ENDINGS, compare, export, tune
from batchpid.sim.cli.identify import excite_joints, identify_logs
from batchpid.sim.cli.rollout import demo, rollout
from batchpid.sim.cli.show import inspect_robot, plot, view

PICTURES = (".png", ".svg")
DOCUMENTS = (".yaml", ".yml")
DEFAULT_ROBOT = "panda"
FOLDER = Path("out")
"""Folder of default outputs, which is made when a file is written; other folders have to exist."""
FIXED: dict[str | None, bool] = {"fixed": True, "free": False}
"""Values of the flag ``--base``."""


class Output(NamedTuple):
    """Output file of a command."""

    content: str
    suffixes: tuple[str, ...]
    default: str = ""
    """Default name, with the values of flags in braces; "" for none."""

    @property
    def help(self) -> str:
        """Help of the flag."""
        default = f" Default: {self.default}." if self.default else ""
        return f"{self.content} to write: {' or '.join(self.suffixes)}.{default}"


class CommandFunction(NamedTuple):
    """Function that is a command."""

    function: Callable[..., Any]
    outputs: Mapping[str, Output] = {}
    loading: tuple[str, ...] = ()
    """Options of :meth:`Robot.load` that are flags."""

    def record(self) -> type:
        """Return the record of the flags."""
        outputs = {name: output.help for name, output in self.outputs.items()}
        return flags.record_of(self.function, self.loading, outputs)


PICTURE = Output("Picture", PICTURES)
COMMANDS = {
    "demo": CommandFunction(demo, {"picture": PICTURE._replace(default="out/{robot}-demo.png")}),
    "rollout": CommandFunction(
        rollout,
        {"out": Output("Recording", (".h5",)), "picture": PICTURE},
        ("base", "actuators"),
    ),
    "tune": CommandFunction(
        tune,
        {"out": Output("Params file", DOCUMENTS, "out/{robot}.tuned.yaml"), "picture": PICTURE},
        ("base", "actuators"),
    ),
    "compare": CommandFunction(compare, {"picture": PICTURE}, ("base", "actuators")),
    "excite": CommandFunction(
        excite_joints, {"out": Output("Setpoints", (".csv",), "out/{robot}.excite.csv")}
    ),
    "identify": CommandFunction(
        identify_logs,
        {"out": Output("Actuators file", DOCUMENTS, "out/{robot}.actuators.yaml")},
        ("base",),
    ),
    "export": CommandFunction(
        export,
        {"out": Output("File", (".h", ".yaml", ".xml", ".urdf"), "out/{robot}-{to}{ending}")},
        ("actuators",),
    ),
    "inspect": CommandFunction(inspect_robot, loading=("base",)),
    "plot": CommandFunction(
        plot,
        {
            "picture": Output(
                "Picture, or film of the first 16 envs,",
                (*PICTURES, ".mp4", ".gif"),
                "{recording}.png",
            )
        },
    ),
    "view": CommandFunction(view, loading=("base", "actuators")),
}


def run(name: str, record: object) -> None:
    """Run a command with the record of its flags."""
    flags.check(record)
    command = COMMANDS[name]
    values = vars(record)
    # A run may take hours: its output files are checked first.
    paths = _output_paths(command, values)
    arguments = _arguments(name, values)
    result = command.function(**arguments)
    # The view has run already, and leaves nothing to report.
    if result is None:
        return
    # The report stands before the files, so that a full disk does not hide it.
    print(result.report())
    for name, path in paths.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        _write(name, result, path)
        print(f"{name.replace('out', 'written')}: {path}")


def _output_paths(command: CommandFunction, values: Document) -> dict[str, Path]:
    """Return the paths of the output files, checked; the outputs without a name are left out."""
    # Defaults are named after the robot, or stand beside the recording.
    words = values | {"robot": Path(values.get("robot") or DEFAULT_ROBOT).stem}
    words["ending"] = ENDINGS.get(values.get("to", ""), "")
    if "recording" in values:
        words["recording"] = values["recording"].parent / values["recording"].stem
    paths: dict[str, Path] = {}
    for name, output in command.outputs.items():
        path = values[name]
        if path is None and output.default:
            path = Path(output.default.format_map(words))
        if path is not None:
            file_path(name, path, output.suffixes)
            check_output(name, path, values["force"])
            paths[name] = path
    return paths


def _arguments(name: str, values: Document) -> Document:
    """Return the arguments of a command's function, with a bar in place of ``progress``, after a
    line about the robot.
    """
    accepted = inspect.signature(COMMANDS[name].function).parameters
    # Output files and --force are for run(), but identify also takes --force.
    arguments = {name: value for name, value in values.items() if name in accepted}
    # A recording has a robot already.
    is_recorded = values.get("recording", values.get("play")) is not None
    if "robot" in values and (values["robot"] or not is_recorded):
        arguments["robot"] = robot = Robot.load(
            values["robot"] or DEFAULT_ROBOT,
            fixed_base=FIXED.get(values.get("base")),
            actuators=values.get("actuators"),
        )
        if not is_recorded:
            print(f"{robot.name}: {robot.dof} dof", flush=True)
    if "progress" in accepted:
        arguments["progress"] = bar(name)
    return arguments


def _write(name: str, result: Any, path: Path) -> None:
    """Write an output file of a result."""
    if name == "out":
        result.save(path)
    elif path.suffix in PICTURES:
        from batchpid.sim import plots

        plots.save(result.figure(), path)
    else:
        result.film(path, progress=bar("filming", unit="frame"))


def check_output(argument: str, path: Path, force: bool) -> None:
    """Check that a file may be written at ``path``.

    Raises InvalidArgumentError if its folder neither exists nor is :data:`FOLDER`, or it exists
    itself and may not be replaced by ``force``.
    """
    if not path.parent.exists() and path.parent != FOLDER:
        problem = f"has no folder {str(path.parent)!r}"
        remedy = f"make it: mkdir -p {shlex.quote(str(path.parent))}"
    elif os.path.lexists(path) and not force:
        problem = "exists already"
        remedy = "add --force to replace it, or choose another name"
    else:
        return
    raise InvalidArgumentError(argument, problem, value=str(path), remedy=remedy)


def bar(label: str, unit: str = "it") -> Progress[Any]:
    """Return a function that wraps an iterable with a bar on a terminal's stderr, shown after 1 s."""
    from tqdm import tqdm

    return partial(
        tqdm,
        desc=label,
        unit=unit,
        delay=1.0,
        disable=None,
        leave=False,
        dynamic_ncols=True,
    )
