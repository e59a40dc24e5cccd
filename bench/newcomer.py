"""Follow the README and the index of the pages in a clean clone, as a newcomer does, and time each command.

    python bench/newcomer.py --out out/newcomer

Needs network. Every command of their shell blocks runs as it stands there, in order, in an environment that ``make
demo`` builds. Program and command of the README also run in the folder that holds the clone, where Python finds the
clone as a namespace package, and in an unrelated one. A command whose error names an extra is repeated after that extra
was installed. Commands of batchpid that have not ended after ``--limit`` seconds, such as ``batchpid view``, are ended
as by Ctrl-C. Two files of a user are supplied: the bundled panda as arm.urdf, and a log of it from MuJoCo.
"""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import tyro

ROOT = Path(__file__).resolve().parent.parent
PAGES = ("README.md", "docs/README.md")
LEFT_OUT = ("pip install '.[view,tune,record]'",)
"""Commands that are not run: extras are installed when a message names them."""
REMEDY = re.compile(r"pip install 'batchpid\[(\w+)\]'")
FILES = """
mkdir -p robots
cp assets/panda.urdf arm.urdf
cp assets/*.urdf robots/
"""
LOG = "python examples/mujoco_log.py arm.urdf --seconds 5 --out log.csv && cp log.params.yaml gains.yaml"


class Step(NamedTuple):
    """A command that has ended."""

    command: str
    seconds: float
    status: int
    stopped: bool
    """Ended at the limit."""
    extra: str | None
    """Extra that the error names."""


@dataclass(frozen=True)
class Options:
    """Follow README and index in a clean clone, and time each command."""

    out: Path
    """Folder of the clone; must not exist."""
    limit: float = 90.0
    """Seconds after which a command is ended."""


def commands(folder: Path) -> list[str]:
    """Return the commands of the shell blocks of the pages in a checkout, without comments."""
    text = "".join((folder / page).read_text() for page in PAGES)
    lines = "".join(re.findall(r"```sh\n(.*?)```", text, re.DOTALL)).splitlines()
    found = [shlex.join(words) for line in lines if (words := shlex.split(line, comments=True))]
    return [command for command in found if command not in LEFT_OUT]


def readme_again(folder: Path) -> list[str]:
    """Return the program of the README of a checkout, as Python reads it from its input, and its last command."""
    text = (folder / "README.md").read_text()
    program, *_ = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    return [f"python - << 'END'\n{program}END", re.findall(r"```sh\n(.*?)\n```", text, re.DOTALL)[-1]]


def run(command: str, folder: Path, limit: float | None, clone: Path | None = None) -> Step:
    """Run a command in ``folder``, with the environment that ``make demo`` has made there or in ``clone``."""
    programs = (clone or folder) / ".venv" / "bin"
    variables = os.environ | {"PATH": f"{programs}{os.pathsep}{os.environ['PATH']}"}
    variables.pop("PYTHONPATH", None)
    start = time.monotonic()
    process = subprocess.Popen(
        ["sh", "-ec", command],
        cwd=folder,
        env=variables,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        errors, stopped = process.communicate(timeout=limit)[1], False
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGINT)
        errors, stopped = process.communicate()[1], True
    extra = REMEDY.search(errors)
    if process.returncode and not stopped:
        print(errors.rstrip(), file=sys.stderr)
    return Step(command, time.monotonic() - start, process.returncode, stopped, extra[1] if extra else None)


def follow(wanted: list[str], folder: Path, limit: float) -> Iterator[Step]:
    """Run commands in order; after an error that names an extra, install it and repeat the command."""
    for command in wanted:
        yield (step := run(command, folder, limit if command.startswith("batchpid") else None))
        if step.status and step.extra:
            yield run(f"pip install --quiet '.[{step.extra}]'", folder, None)
            yield run(command, folder, limit)


def main(options: Options) -> int:
    """Print the seconds of each step and of all; return the number of steps that failed without a remedy."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job ignores it, and so would its children
    subprocess.run(["git", "clone", "--quiet", ROOT, options.out], check=True)
    folder = options.out.resolve()
    wanted = commands(folder)
    wanted.insert(1, FILES)
    identify = next(at for at, command in enumerate(wanted) if command.startswith("batchpid identify"))
    wanted.insert(identify, LOG)
    first, *others = wanted
    with tempfile.TemporaryDirectory() as unrelated:
        places = folder, folder.parent, Path(unrelated)
        again = (run(command, place, None, folder) for place in places for command in readme_again(folder))
        return report(chain([run(first, folder, None)], again, follow(others, folder, options.limit)))


def report(steps: Iterable[Step]) -> int:
    """Print the seconds of each step and of all; return the number of steps that failed without a remedy."""
    total, failed = 0.0, 0
    for step in steps:
        total += step.seconds
        problem = step.status != 0 and not step.stopped and step.extra is None
        failed += problem
        says = "ended" if step.stopped else f"asks for {step.extra}" if step.extra else "failed" if problem else ""
        print(f"{step.seconds:6.1f} s  {' '.join(step.command.split())[:90]:90}  {says}", flush=True)
    print(f"{total / 60:.1f} min, {failed} failed")
    return failed


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Options, description=__doc__)))
