"""The command ``batchpid``, also as ``python -m batchpid``."""

from __future__ import annotations

import os
import signal
import sys


def main() -> int:
    """Run the command line as a program, with three standard streams."""
    _open_closed_streams()
    try:
        from batchpid.sim.cli import main as run

        return run()
    finally:
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, signal.SIG_DFL)  # at the end of Python it would print a traceback


def _open_closed_streams() -> None:
    """Open the null device for each standard stream that is closed, before another file takes its number."""
    for number, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        try:
            os.fstat(number)
        except OSError:
            os.dup2(os.open(os.devnull, os.O_RDWR), number)
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, mode, closefd=False))  # noqa: SIM115
    sys.stdout.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]  # as stderr, for any file name


if __name__ == "__main__":
    raise SystemExit(main())
