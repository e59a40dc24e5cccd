"""The command ``batchpid``, also as ``python -m batchpid``."""

from __future__ import annotations

import sys


def main() -> int:
    """Run the command line as a program."""
    try:
        from batchpid.sim.cli import main as run

        sys.stdout.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]  # as stderr, for any file name
        return run()
    except KeyboardInterrupt:  # in an import, or at the end
        print("batchpid: interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    raise SystemExit(main())
