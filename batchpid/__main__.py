"""``python -m batchpid`` is the command ``batchpid``."""

from batchpid.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
