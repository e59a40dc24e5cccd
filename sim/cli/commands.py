"""Table of the commands, and the execution of one: inputs, outputs, report."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from batchpid.arrays.array_types import Document
from batchpid.io.files import write_atomically
from batchpid.sim import Robot
from batchpid.sim.cli import flags
from batchpid.sim.cli.excite import excite_joints
from batchpid.sim.cli.export import ENDINGS, export
from batchpid.sim.cli.identify import identify_logs
from batchpid.sim.cli.inspect import inspect_robot
from batchpid.sim.cli.outputs import OutputFiles, bar, write_figures
from batchpid.sim.cli.plot import plot
from batchpid.sim.cli.rollout import demo, rollout
from batchpid.sim.cli.view import view
from batchpid.sim.engine.protocol import load_engine
from batchpid.sim.options.options import RunnerOptions
from batchpid.sim.tuning.comparison import compare, default_sets
from batchpid.sim.tuning.evaluation import tuning_engine
from batchpid.sim.tuning.gain_sets import default_gains
from batchpid.sim.tuning.randomization_files import load_randomization
from batchpid.sim.tuning.search import tune

PICTURES = (".png", ".svg")
DOCUMENTS = (".yaml", ".yml", ".json")


class Output(NamedTuple):
    """Output file of a command."""

    content: str
    suffixes: tuple[str, ...]
    default: str = ""
    """Template of the default name from the flags and the stems ``{robot}``, ``{out}`` and
    ``{recording}``; "" for none.
    """

    @property
    def help(self) -> str:
        """Help of the flag."""
        names = {"{robot}": "ROBOT", "{out}": "NAME", "{recording}": "NAME", "{kind}": "KIND"}
        default = self.default
        for name, word in names.items():
            default = default.replace(name, word)
        suffixes = " or ".join(self.suffixes)
        return f"{self.content} to write: {suffixes}.{f' Default: {default}.' if default else ''}"


class CommandFunction(NamedTuple):
    """Function that is a command."""

    function: Callable[..., Any]
    outputs: dict[str, Output]
    options: tuple[str, ...] = ()
    """Options of a Runner that are flags."""
    loading: tuple[str, ...] = ("base",)
    """Options of :meth:`Robot.load` that are flags."""

    def record(self) -> type[Any]:
        """Return the record of the flags."""
        return _record(self.function, self.options, self.loading, tuple(self.outputs.items()))


FIGURES = Output("Figures", (".json",))
PICTURE = Output("Picture", PICTURES)
COMMANDS = {
    "demo": CommandFunction(
        demo,
        {"picture": PICTURE._replace(default="out/{robot}-demo.png")},
        ("engine", "workers"),
        (),
    ),
    "rollout": CommandFunction(
        rollout,
        {"out": Output("Recording", (".h5",)), "picture": PICTURE, "json": FIGURES},
        ("engine", "workers", "backend", "compensate", "ground"),
        ("base", "actuators"),
    ),
    "tune": CommandFunction(
        tune,
        {
            "out": Output("Params file", DOCUMENTS, "out/{robot}.tuned.yaml"),
            "picture": PICTURE._replace(default="{out}-tune.png"),
        },
        loading=("base", "actuators"),
    ),
    "compare": CommandFunction(
        compare, {"picture": PICTURE, "json": FIGURES}, loading=("base", "actuators")
    ),
    "excite": CommandFunction(
        excite_joints, {"out": Output("Setpoints", (".csv",), "out/{robot}.excite.csv")}, (), ()
    ),
    "identify": CommandFunction(
        identify_logs,
        {
            "out": Output("Actuators file", DOCUMENTS, "out/{robot}.actuators.yaml"),
            "picture": PICTURE._replace(default="{out}-fit.png"),
            "json": FIGURES,
            "corrected_urdf": Output("URDF with the masses that were found", (".urdf",)),
        },
        loading=(),
    ),
    "export": CommandFunction(
        export,
        {"out": Output("File", (".h", ".yaml", ".xml", ".urdf"), "out/{robot}{ending}")},
        loading=("actuators",),
    ),
    "inspect": CommandFunction(inspect_robot, {"json": FIGURES}),
    "plot": CommandFunction(
        plot,
        {
            "picture": Output(
                "Picture, or film of the first 16 envs,",
                (*PICTURES, ".mp4", ".gif"),
                "{recording}-{kind}.png",
            )
        },
        loading=(),
    ),
    "view": CommandFunction(view, {}, ("engine", "workers"), ("base", "actuators")),
}


def execute(command: CommandFunction, values: Document) -> int:
    """Run a command with the values of its flags, and return its exit status."""
    # A run may take hours: its output files are checked first.
    files = OutputFiles(values, command.outputs)
    paths: dict[str, Path] = {}
    for name, output in command.outputs.items():
        path = values[name] or _default(output.default, values | paths)
        if path is not None:
            paths[name] = files.path(name, path, output.suffixes)
    arguments = _arguments(command, values)
    result = command.function(**arguments)
    # The view has run already, and leaves nothing to report.
    if result is None:
        return 0
    # The report stands before the files, so that a full disk does not hide it.
    print(result.report())
    for name, path in paths.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        _write(name, result, path)
        print(f"{name.replace('out', 'written')}: {path}")
    return getattr(result, "status", 0)


@cache
def _record(
    function: Callable[..., Any],
    options: tuple[str, ...],
    loading: tuple[str, ...],
    outputs: tuple[tuple[str, Output], ...],
) -> type[Any]:
    return flags.record_of(
        function, options, loading, {name: output.help for name, output in outputs}
    )


def _arguments(command: CommandFunction, values: Document) -> Document:
    """Return the arguments of a command's function, with a bar in place of ``progress``, after a
    line about them.
    """
    accepted = inspect.signature(command.function).parameters
    # Output files and --force are for execute(), but identify also takes --force.
    arguments = {name: value for name, value in values.items() if name in accepted}
    for name in command.options:
        # On and off are switches; one that is left out is left to the Runner.
        if values[name] is not None:
            arguments[name] = {"on": True, "off": False}.get(values[name], values[name])
    # A recording may stand in place of a robot.
    if values.get("robot") is not None:
        loading: Document = {}
        if values.get("base") is not None:
            loading["fixed_base"] = values["base"] == "fixed"
        if values.get("actuators") is not None:
            loading["actuators"] = values["actuators"]
        arguments["robot"] = robot = Robot.load(values["robot"], **loading)
        # Distributions are checked against the joints and links of the robot.
        if values.get("randomize") is not None:
            arguments["randomization"] = load_randomization(values["randomize"], robot)
        print(_heading(robot, values), flush=True)
        if values.get("engine") == "sapien":
            print("MuJoCo is several times as fast, with other contacts: --engine mujoco")
    if "progress" in accepted:
        arguments["progress"] = bar(command.function.__name__)
    return arguments


def _heading(robot: Robot, values: Document) -> str:
    """Return a line with robot, engine, gains, rate and number of robots."""
    parts = []
    # A search leaves the engine out, a comparison may have both.
    if "engine" in values:
        names = values["engine"] or tuning_engine(None)
        names = (names,) if isinstance(names, str) else names
        parts.append(" and ".join(load_engine(name).title for name in names))
    if "gains" in values:
        names = values["gains"] or (
            default_sets(robot) if "moves" in values else default_gains(robot)
        )
        parts.append(f"gains {names if isinstance(names, str) else ', '.join(names)}")
    if values.get("control", "pid") != "pid":
        parts.append(f"control {values['control']}")
    if "timestep" in values or "engine" in values:
        parts.append(f"{1 / (values.get('timestep') or RunnerOptions.timestep):g} Hz")
    if "num_envs" in values:
        parts.append(f"{values['num_envs']} robots")
    if "moves" in values:
        parts.append(f"{values['moves']} random moves")
    base = "" if robot.fixed_base else "free base, "
    return f"{robot.name}: {base}{', '.join(parts) or f'{robot.dof} joints'}"


def _default(template: str, values: Document) -> Path | None:
    """Return the default name of an output file."""
    if not template:
        return None
    # A template may use every flag: {kind} of plot, and these.
    stems: Document = {"ending": ENDINGS.get(values.get("to", ""))}
    for name in ("out", "recording"):
        if values.get(name) is not None:
            stems[name] = values[name].parent / values[name].stem
    if values.get("robot") is not None:
        stems["robot"] = Path(values["robot"]).stem
    return Path(template.format_map(values | stems))


def _write(name: str, result: Any, path: Path) -> None:
    """Write an output file of a result."""
    if name == "out":
        result.save(path)
    elif name == "json":
        write_figures(path, result.document())
    elif name == "corrected_urdf":
        write_atomically(path, result.corrected_urdf())
    elif path.suffix in PICTURES:
        from batchpid.sim import plots

        plots.save(result.figure(), path)
    else:
        result.film(path, progress=bar("filming", unit="frame"))
