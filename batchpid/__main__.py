"""The command ``batchpid``, also as ``python -m batchpid``."""

from __future__ import annotations

import sys

from batchpid.errors import BatchPIDError


def main() -> int:
    """Run the command line as a program."""
    try:
        from batchpid.sim.cli import main as run

        sys.stdout.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]  # as stderr, for any file name
        return run()
    except KeyboardInterrupt:  # in an import, or at the end
        print("batchpid: interrupted", file=sys.stderr)
        return 130
    except BatchPIDError as error:  # in an import
        print(f"batchpid: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    raise SystemExit(main())
