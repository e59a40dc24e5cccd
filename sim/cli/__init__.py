"""The command line: each command is a frozen dataclass whose fields are its flags.

To add a command, write a module with such a dataclass and list it in :data:`COMMANDS`. The range of
a number is a :class:`batchpid.arrays.field_tables.Field` in its annotation, and is checked before
``run()`` starts, which returns the exit status (None: 0). Modules that load SAPIEN or Matplotlib
are named in ``imports`` and imported after the flags are parsed, so that ``--help`` answers at
once.
"""

from __future__ import annotations

import importlib
import os
import signal
import sys
import warnings
from collections.abc import Sequence
from typing import Any

import tyro

import batchpid
from batchpid.errors import BatchPIDError
from batchpid.sim.cli import flags
from batchpid.sim.cli.compare import CompareCommand
from batchpid.sim.cli.demo import DemoCommand
from batchpid.sim.cli.excite import ExciteCommand
from batchpid.sim.cli.export import ExportCommand
from batchpid.sim.cli.identify import IdentifyCommand
from batchpid.sim.cli.inspect import InspectCommand
from batchpid.sim.cli.outputs import close_bars
from batchpid.sim.cli.plot import PlotCommand
from batchpid.sim.cli.rollout import RolloutCommand
from batchpid.sim.cli.tune import TuneCommand
from batchpid.sim.cli.view import ViewCommand

COMMANDS: dict[str, type[Any]] = {
    "demo": DemoCommand,
    "rollout": RolloutCommand,
    "tune": TuneCommand,
    "compare": CompareCommand,
    "excite": ExciteCommand,
    "identify": IdentifyCommand,
    "export": ExportCommand,
    "inspect": InspectCommand,
    "plot": PlotCommand,
    "view": ViewCommand,
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status.

    0: success. 2: bad input, or a file that cannot be written. 3: no env of ``rollout`` or ``demo``
        settled. 130:
    Ctrl-C. 141: the reader of stdout closed it, as in ``| head``. 2 and 130 come with one line on
    stderr.
    """
    message = None
    try:
        status = _run(list(sys.argv[1:] if argv is None else argv))
        sys.stdout.flush()
    except BatchPIDError as error:
        status, message = 2, str(error)
    except KeyboardInterrupt:
        status, message = 128 + signal.SIGINT, "interrupted"
    except BrokenPipeError:
        status = 128 + signal.SIGPIPE
        os.dup2(
            os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno()
        )  # Python flushes it once more at exit
    except OSError as error:
        status, message = (
            2,
            (
                f"{error.filename}: {error.strerror}"
                if error.filename
                else error.strerror or str(error)
            ),
        )
    if message is not None:
        close_bars()
        print("batchpid:", " ".join(message.splitlines()), file=sys.stderr)
    return status


def _run(arguments: list[str]) -> int:
    """Run one command and return its exit status, or raise its error."""
    if arguments == ["--version"]:
        print(batchpid.__version__)
        return 0
    with warnings.catch_warnings():
        warnings.showwarning = _show_warning
        try:
            command = parse(arguments)
        except SystemExit as end:  # after --help, or a message about unknown flags
            return int(end.code or 0)
        flags.check(command)
        for name in command.imports:
            importlib.import_module(name)
        return command.run() or 0


def parse(arguments: Sequence[str]) -> Any:
    """Return the command with its flags; for --help or unknown flags print help and raise
    SystemExit.
    """
    if os.environ.get("NO_COLOR"):
        os.environ["TERM"] = "dumb"  # tyro colours its help on every other terminal
    options = (
        tyro.conf.DisallowNone,  # a flag is left out, not given None
        tyro.conf.FlagCreatePairsOff,  # --force without --no-force
        tyro.conf.PositionalMetavarFromFieldName,
        # Without a help of the choice itself, tyro looks for one in the source of `typing`, which
        # takes 0.05 s.
        tyro.conf.arg(help="`batchpid COMMAND --help` lists the flags of a command."),
    )
    if arguments and arguments[0] in COMMANDS:  # alone, so that a message names its help
        prog, command = f"batchpid {arguments[0]}", COMMANDS[arguments[0]]
        return tyro.cli(command, prog=prog, args=arguments[1:], config=options)
    app = tyro.extras.SubcommandApp()
    for name, command in COMMANDS.items():
        app.command(name=name, help=(command.__doc__ or "").partition("\n")[0])(command)
    about = "Joint-level PID control for many robots at once, in SAPIEN or MuJoCo."
    return app.cli(prog="batchpid", description=about, args=arguments, config=options)


def _show_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    print(f"batchpid: warning: {message}", file=sys.stderr)
