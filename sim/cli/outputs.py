"""Output of the commands: files, checked before the run, and progress bars.

A run may take hours, so files are checked before it. No file is replaced without ``--force``.
"""

from __future__ import annotations

import json
import math
import os
import shlex
import sys
import weakref
from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from batchpid.arrays.array_types import Document
from batchpid.checks.validate import file_path
from batchpid.errors import InvalidArgumentError
from batchpid.io.files import write_atomically

if TYPE_CHECKING:
    from tqdm import tqdm

FOLDER = Path("out")
"""Folder of default outputs, which is made when a file is written; other folders have to exist."""


class OutputFiles:
    """Output files of one run. With ``--force`` they replace files, but none that the command
    reads: that any flag but ``names`` names.
    """

    def __init__(self, values: Document, names: Collection[str]) -> None:
        self._force: bool = values.get("force", False)
        self._outputs = list[str]()
        self._inputs = list[str | Path]()
        for name, value in values.items():
            paths = value if isinstance(value, tuple) else (value,)
            if name not in names:
                self._inputs += [
                    path for path in paths if isinstance(path, str | Path) and os.path.isfile(path)
                ]

    def path(self, argument: str, path: Path, suffixes: Collection[str]) -> Path:
        """Return ``path`` after a check that a file may be written there.

        Raises InvalidArgumentError if its suffix is not one of ``suffixes``, its folder neither
        exists nor is :data:`FOLDER`, the command reads it or writes it as another output, or it
        exists and may not be replaced.
        """
        file_path(argument, path, suffixes)
        self._check(argument, path)
        self._outputs.append(os.path.realpath(path))
        return path

    def _check(self, argument: str, path: Path) -> None:
        folder = str(path.parent)
        remedy = "choose another file"
        # Links count as the file that they lead to, so that none is read and replaced at once.
        if os.path.exists(path) and any(os.path.samefile(path, source) for source in self._inputs):
            problem = "is a file to read"
        elif os.path.realpath(path) in self._outputs:
            problem = "is another output of this run"
        elif not path.parent.exists() and path.parent != FOLDER:
            problem = f"has no folder {folder!r}"
            remedy = f"make it: mkdir -p {shlex.quote(folder)}"
        elif os.path.lexists(path) and not self._force:
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


_bars: weakref.WeakSet[tqdm[Any]] = weakref.WeakSet()


def bar(label: str, **options: Any) -> Callable[[Iterable[Any]], Iterable[Any]]:
    """Return a function that wraps an iterable with a bar on stderr, shown after 1 s; ``options``
    go to tqdm.

    A file as stderr gets no bar.
    """
    from tqdm import tqdm

    fixed = {"leave": False, "dynamic_ncols": True, "disable": not sys.stderr.isatty()}
    options = {"delay": 1.0, **options, **fixed}

    def wrap(items: Iterable[Any]) -> Iterable[Any]:
        # Kept to be closed by an error's message.
        shown = tqdm(items, desc=label, **options)
        _bars.add(shown)
        return shown

    return wrap


def close_bars() -> None:
    """Remove all bars, so that a message gets a separate line; an error may have left some."""
    for open_bar in list(_bars):
        open_bar.close()
