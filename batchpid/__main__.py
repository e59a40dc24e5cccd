"""The command ``batchpid``, also as ``python -m batchpid``."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path


def main() -> int:
    """Hand over to the command line, unless the user's own ``sim.py`` or ``assets.py`` would be imported for it."""
    for name in ("sim", "assets"):
        origin = getattr(importlib.util.find_spec(name), "origin", None)
        if origin and Path(origin) != Path(__file__).parents[1] / name / "__init__.py":
            remedy = "rename it or run in another folder"
            print(f"batchpid: {origin} hides the package {name!r} that batchpid needs; {remedy}", file=sys.stderr)
            return 2
    from sim.cli import main

    return main()


if __name__ == "__main__":
    raise SystemExit(main())
