"""Output of the commands: files and progress bars.

No file is replaced without ``--force``, and no input at all.
"""

from __future__ import annotations

import json
import math
import os
import shlex
import sys
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from batchpid.errors import InvalidArgumentError
from batchpid.io.files import write_atomically

FOLDER = Path("out")
"""Folder of default outputs, which is made when a file is written; other folders have to exist."""


def check_output(
    argument: str, path: Path, inputs: Iterable[Path], outputs: Iterable[Path], force: bool
) -> None:
    """Check that a file may be written at ``path``.

    Raises InvalidArgumentError if the command reads it (one of ``inputs``) or writes it as another
    one of its ``outputs``, its folder neither exists nor is :data:`FOLDER`, or it exists and may
    not be replaced by ``force``.
    """
    remedy = "choose another file"
    # Links count as the file that they lead to, so that none is read and replaced at once.
    if path.exists() and any(path.samefile(source) for source in inputs):
        problem = "is a file to read"
    elif path.resolve() in [other.resolve() for other in outputs]:
        problem = "is another output of this run"
    elif not path.parent.exists() and path.parent != FOLDER:
        problem = f"has no folder {str(path.parent)!r}"
        remedy = f"make it: mkdir -p {shlex.quote(str(path.parent))}"
    elif os.path.lexists(path) and not force:
        problem = "exists already"
        remedy = "add --force to replace it, or choose another name"
    else:
        return
    raise InvalidArgumentError(argument, problem, value=str(path), remedy=remedy)


def write_figures(path: Path, figures: Any) -> None:
    """Write figures as JSON: arrays as lists, named tuples and mappings as objects, null for NaN
    and infinity.
    """
    write_atomically(path, json.dumps(_plain(figures), indent=1, allow_nan=False) + "\n")


def _plain(value: Any) -> Any:
    # Named tuples keep their names; JSON has no NaN.
    if hasattr(value, "_asdict"):
        value = value._asdict()
    elif hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {name: _plain(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def bar(label: str, **options: Any) -> Callable[[Iterable[Any]], Iterable[Any]]:
    """Return a function that wraps an iterable with a bar on stderr, shown after 1 s; ``options``
    go to tqdm.

    A file as stderr gets no bar.
    """
    from tqdm import tqdm

    shown = {"delay": 1.0, "leave": False, "dynamic_ncols": True, **options}
    return partial(tqdm, desc=label, disable=not sys.stderr.isatty(), **shown)
