"""The command line: a table of commands, each a frozen dataclass whose flags tyro builds.

A command is loaded only when it is named, and does its heavy imports inside ``run``, so that ``--help`` answers at
once. To add one, write a module with a frozen dataclass that has ``run(self) -> int | None``, and add a line below.
"""

from __future__ import annotations

import difflib
import importlib
import importlib.metadata
import os
import signal
import sys
import warnings
from collections.abc import Sequence
from typing import Any, Protocol

COMMANDS = {
    # name: (module:class, summary)
    "demo": ("sim.cli.demo:Demo", "64 arms close on the tutorial's setpoint: a table and a picture"),
    "rollout": (
        "sim.cli.rollout:Rollout",
        "N of any robot follow a setpoint; what happened goes to a file",
    ),
    "bench": ("sim.cli.bench:Bench", "the closed loop beside the tutorial's loop and the bare engine"),
    "tune": ("sim.cli.tune:Tune", "gains that settle, for any robot, found on the real scenes"),
    "compare": ("sim.cli.compare:Compare", "sets of gains on the same moves: a table and a picture"),
    "inspect": ("sim.cli.inspect:Inspect", "the joints of a robot, and what is odd about it"),
    "plot": ("sim.cli.plot:Plot", "a picture of a recording, or of two side by side"),
    "view": ("sim.cli.view:View", "robots in the browser, live: sliders, charts, pushes and payloads"),
    "render": ("sim.cli.render:Render", "a film of a recorded run, by SAPIEN's renderer where it works"),
}


class Command(Protocol):
    """What a command is: its fields are the flags, and ``run`` returns the exit status (None: 0)."""

    def run(self) -> int | None:
        """Do it."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status: 0, 2 for bad input, 130 after Ctrl-C, 141 for a closed pipe."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    name = arguments[0] if arguments else "--help"
    if name in ("-h", "--help", "help"):
        print(_overview())
        return 0 if arguments else 2
    if name == "--version":
        print(_version())
        return 0
    if name not in COMMANDS:
        close = difflib.get_close_matches(name, COMMANDS, n=1)
        hint = f"did you mean {close[0]!r}?" if close else f"choose one of {', '.join(COMMANDS)}"
        return _complain(f"no command {name!r}; {hint}")
    return _run(name, arguments[1:])


def _run(name: str, arguments: list[str]) -> int:
    from batchpid.errors import BatchPIDError

    with warnings.catch_warnings():
        warnings.showwarning = _show_warning
        try:
            command = parse(name, arguments)
            status = command.run()
            sys.stdout.flush()
        except BatchPIDError as error:
            return _complain(str(error))
        except KeyboardInterrupt:
            return _complain("interrupted", 128 + signal.SIGINT)
        except BrokenPipeError:
            # The reader left (``| head``). Python flushes stdout once more at exit: let that go nowhere.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 128 + signal.SIGPIPE
        except OSError as error:
            where = f"{error.filename}: " if error.filename else ""
            return _complain(f"{where}{error.strerror or error}")
    return status or 0


def load(name: str) -> Any:
    """Return the dataclass of a command."""
    module, _, attribute = COMMANDS[name][0].partition(":")
    return getattr(importlib.import_module(module), attribute)


def parse(name: str, arguments: Sequence[str]) -> Command:
    """Return the command with its flags; for flags it does not know, or --help, print what helps and exit."""
    import tyro

    plain = (
        tyro.conf.DisallowNone,  # a flag is left out, not given None
        tyro.conf.FlagCreatePairsOff,  # --viewer, and no --no-viewer beside it
        tyro.conf.PositionalMetavarFromFieldName,
    )
    parsed: Command = tyro.cli(load(name), prog=f"batchpid {name}", args=list(arguments), config=plain)
    return parsed


def _version() -> str:
    try:
        return importlib.metadata.version("batchpid")
    except importlib.metadata.PackageNotFoundError:
        return "not installed: running from its source tree"


def _overview() -> str:
    width = max(map(len, COMMANDS))
    lines = [f"  {name:<{width}}  {summary}" for name, (_, summary) in COMMANDS.items()]
    return "\n".join(
        [
            "usage: batchpid COMMAND [flags]     (batchpid COMMAND --help lists the flags)",
            "",
            "Joint-level PID control for many robots at once, in SAPIEN.",
            "",
            *lines,
        ]
    )


def _complain(message: str, status: int = 2) -> int:
    print(f"batchpid: {message}", file=sys.stderr)
    return status


def _show_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    print(f"batchpid: warning: {message}", file=sys.stderr)
