"""The command line: each command is a frozen dataclass whose fields are its flags.

To add a command, write a module with such a dataclass and list it in :data:`COMMANDS`. Its ``run()`` returns the exit
status (None: 0) and imports what loads SAPIEN, Matplotlib or JAX, so that ``--help`` answers at once.
"""

from __future__ import annotations

import os
import signal
import sys
import warnings
from collections.abc import Sequence
from typing import Any

import tyro

from batchpid.errors import BatchPIDError
from batchpid.versions import package_versions
from sim.cli.bench import BenchCommand
from sim.cli.compare import CompareCommand
from sim.cli.demo import DemoCommand
from sim.cli.inspect import InspectCommand
from sim.cli.plot import PlotCommand
from sim.cli.render import RenderCommand
from sim.cli.rollout import RolloutCommand
from sim.cli.survey import SurveyCommand
from sim.cli.tune import TuneCommand
from sim.cli.view import ViewCommand

COMMANDS: dict[str, type[Any]] = {
    "demo": DemoCommand,
    "rollout": RolloutCommand,
    "bench": BenchCommand,
    "tune": TuneCommand,
    "compare": CompareCommand,
    "inspect": InspectCommand,
    "survey": SurveyCommand,
    "plot": PlotCommand,
    "view": ViewCommand,
    "render": RenderCommand,
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status.

    0: success. 2: bad input. 130: Ctrl-C. 141: the reader of stdout closed it, as in ``| head``.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        if arguments == ["--version"]:
            print(package_versions(["batchpid"]).get("batchpid", "not installed: running from its source tree"))
            return 0
        with warnings.catch_warnings():
            warnings.showwarning = _show_warning
            status = parse(arguments).run()
            sys.stdout.flush()
    except BatchPIDError as error:
        return _fail(str(error))
    except KeyboardInterrupt:
        return _fail("interrupted", 128 + signal.SIGINT)
    except BrokenPipeError:
        # Python flushes stdout once more at exit, which must not fail again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + signal.SIGPIPE
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return _fail(f"{where}{error.strerror or error}")
    return status or 0


def parse(arguments: Sequence[str]) -> Any:
    """Return the command with its flags; for --help or unknown flags print help and raise SystemExit."""
    app = tyro.extras.SubcommandApp()
    named = bool(arguments) and arguments[0] in COMMANDS
    for name, command in COMMANDS.items():
        # The overview shows the first line of each docstring, the help of a command shows all of it.
        summary = None if named else (command.__doc__ or "").partition("\n")[0]
        app.command(name=name, help=summary)(command)
    options = (
        tyro.conf.DisallowNone,  # a flag is left out, not given None
        tyro.conf.FlagCreatePairsOff,  # --viewer without --no-viewer
        tyro.conf.PositionalMetavarFromFieldName,
    )
    about = "Joint-level PID control for many robots at once, in SAPIEN."
    return app.cli(prog="batchpid", description=about, args=arguments, config=options)


def _fail(message: str, status: int = 2) -> int:
    print(f"batchpid: {message}", file=sys.stderr)
    return status


def _show_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    print(f"batchpid: warning: {message}", file=sys.stderr)
