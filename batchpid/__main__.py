"""``python -m batchpid`` is the command ``batchpid``."""

from sim.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
