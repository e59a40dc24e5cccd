"""The command line: each command is a function, whose annotations are the flags and whose docstring
is the help.

The result writes itself. ``report()`` is printed, and the output files come from ``save(path)`` and
``figure()``. To add a command, write such a function
and list it in :data:`SUMMARIES`, and in ``COMMANDS`` of the module of commands, which the overview
does not import.
"""

from __future__ import annotations

import os
import signal
import sys
import warnings
from collections.abc import Sequence
from typing import Any

import batchpid
from batchpid.checks import choice
from batchpid.errors import BatchPIDError

INPUT_ERROR = 2
SUMMARIES = {
    "demo": "Move 64 arms to a setpoint.",
    "rollout": "Move N of any robot to a setpoint or along a trajectory.",
    "tune": "Tune the gains of any robot.",
    "compare": "Compare sets of gains on the same moves.",
    "excite": "Make the motion to record for identification.",
    "identify": "Identify a robot's motors from logs of its motion.",
    "export": "Write a robot's gains, or the robot itself, for another program.",
    "inspect": "List findings about a robot, its joints and masses.",
    "plot": "Draw a recorded run, or film it.",
    "view": "Show moving robots in the browser.",
}
"""Every command, with its line in the overview."""
OVERVIEW = "\n".join(
    [
        "usage: batchpid COMMAND ...\n",
        "Joint-level PID control for many robots at once, in SAPIEN or MuJoCo.\n",
        *(f"  {name:10}{summary}" for name, summary in SUMMARIES.items()),
        "\n`batchpid COMMAND --help` lists the flags of a command.",
    ]
)
"""Help of the whole."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status.

    0: success. 2: bad input, or a file that cannot be written. 130: Ctrl-C. 141: the reader of
    stdout closed it, as in ``| head``. 2 and 130 come with one line on stderr.
    """
    arguments = sys.argv[1:] if argv is None else argv
    try:
        status = _run(list(arguments))
        # A closed pipe shows when the rest of the text is written.
        sys.stdout.flush()
        return status
    except BatchPIDError as error:
        return _fail(INPUT_ERROR, str(error))
    except KeyboardInterrupt:
        return _fail(128 + signal.SIGINT, "interrupted")
    except BrokenPipeError:
        # Python flushes stdout once more at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + signal.SIGPIPE
    except OSError as error:
        problem = error.strerror or str(error)
        return _fail(INPUT_ERROR, f"{error.filename}: {problem}" if error.filename else problem)


def parse(arguments: Sequence[str]) -> tuple[str, object]:
    """Return the name of the command and the record of its flags; for --help or unknown flags print
    help and raise SystemExit.
    """
    if os.environ.get("NO_COLOR"):
        os.environ["TERM"] = "dumb"  # tyro colours its help on every other terminal
    # A command is parsed alone, so that a message names its help.
    if arguments and not arguments[0].startswith("-"):
        name, *words = arguments
        choice("command", name, SUMMARIES)
        import tyro

        from batchpid.sim.cli.commands import COMMANDS

        config = (
            tyro.conf.DisallowNone,  # a flag is left out, not given None
            tyro.conf.FlagCreatePairsOff,  # --force without --no-force
            tyro.conf.PositionalMetavarFromFieldName,
        )
        record = COMMANDS[name].record()
        return name, tyro.cli(record, prog=f"batchpid {name}", args=words, config=config)
    is_help = not {"-h", "--help"}.isdisjoint(arguments)
    print(OVERVIEW, file=sys.stdout if is_help else sys.stderr)
    raise SystemExit(0 if is_help else INPUT_ERROR)


def _run(arguments: list[str]) -> int:
    """Run one command and return its exit status, or raise its error."""
    if arguments == ["--version"]:
        print(batchpid.__version__)
        return 0
    with warnings.catch_warnings():
        warnings.showwarning = _show_warning
        try:
            name, flags = parse(arguments)
        except SystemExit as end:  # after --help, or a message about unknown flags
            return int(end.code or 0)
        from batchpid.sim.cli.commands import run

        run(name, flags)
    return 0


def _fail(status: int, message: str) -> int:
    """Print a message in one line, and return the status."""
    from tqdm import tqdm

    # An error may leave a bar behind, which tqdm moves out of the way of the message.
    tqdm.write(f"batchpid: {' '.join(message.splitlines())}", file=sys.stderr)
    return status


def _show_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    print(f"batchpid: warning: {message}", file=sys.stderr)
