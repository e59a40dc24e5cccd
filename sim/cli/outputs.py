"""Output of the commands: files, with default names and checks before the run, and progress bars.

A run may take hours, so every possible check is made before it. No file is replaced without ``--force``.
"""

from __future__ import annotations

import json
import math
import os
import shlex
import sys
import weakref
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from threading import Event, Thread
from typing import TYPE_CHECKING, Any, TypeVar

from batchpid.checks.validate import file_path
from batchpid.errors import InvalidArgumentError
from batchpid.io.files import try_writing, write_atomically

if TYPE_CHECKING:
    from tqdm import tqdm

FOLDER = Path("out")
"""Folder of default outputs, which is made when a file is written; other folders have to exist."""
P = TypeVar("P", bound=Path | None)


class OutputFiles:
    """Output files of one run of a command.

    Parameters
    ----------
    force
        Whether existing files are replaced.
    inputs
        Files that the command reads, which are never replaced. None entries are ignored.
    """

    def __init__(self, *, force: bool, inputs: Iterable[Path | None] = ()) -> None:
        self._force = force
        self._taken = {os.path.realpath(path): "is a file to read" for path in inputs if path is not None}

    def path(self, argument: str, path: P, suffixes: Collection[str]) -> P:
        """Return ``path`` after a check that a file can be written there; None is returned as None.

        The check leaves nothing behind. Raises InvalidArgumentError if its suffix is not one of ``suffixes``, its
        folder neither exists nor is :data:`FOLDER`, it cannot be written, the command reads it or writes it as another
        output, or it exists and may not be replaced.
        """
        if path is not None:
            file_path(argument, path, suffixes)
            self._check(argument, path, None if self._force else "add --force to replace it, or choose another name")
        return path

    def history(self, path: Path, *, resume: bool) -> Path:
        """Return the ``path`` of the state of a search or fit after a check; with ``resume`` the file may exist.

        Without ``resume``, but with ``--force``, the state of a stopped run is removed. Raises InvalidArgumentError as
        for :meth:`path`.
        """
        remedy = "add --resume to continue the stopped run, --force to begin anew, or choose another --out"
        self._check("out", path, None if self._force or resume else remedy)
        if not resume:
            path.unlink(missing_ok=True)
        return path

    def _check(self, argument: str, path: Path, keep: str | None) -> None:
        """Check that a file can be written; ``keep`` is the remedy if an existing one may not be replaced."""
        target = os.path.realpath(path)
        problem, remedy = self._taken.get(target), "choose another file"
        try:
            try_writing(path)
        except OSError as error:
            problem = f"cannot be written: {error.strerror}"
        folder = path.parent
        if problem is None and not folder.exists() and folder != FOLDER:
            problem, remedy = f"has no folder {str(folder)!r}", f"make it: mkdir -p {shlex.quote(str(folder))}"
        if problem is None and keep is not None and os.path.lexists(path):
            problem, remedy = "exists already", keep
        if problem is not None:
            raise InvalidArgumentError(argument, problem, value=str(path), remedy=remedy)
        self._taken[target] = "is another output of this run"


def write_figures(path: Path, figures: Any) -> None:
    """Write figures as JSON: arrays as lists, named tuples and mappings as objects, null for NaN and infinity."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, json.dumps(_plain(figures), indent=1, allow_nan=False) + "\n")


def _plain(value: Any) -> Any:
    value = value._asdict() if hasattr(value, "_asdict") else value.tolist() if hasattr(value, "tolist") else value
    if isinstance(value, Mapping):
        return {name: _plain(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def beside(path: Path, shown: str, suffix: str = ".png") -> Path:
    """Return the default path of a picture or film of ``path``, in the same folder: NAME-SHOWN.png."""
    return path.with_name(f"{path.stem}-{shown}{suffix}")


AT_MOST = "{desc}: {n_fmt} of at most {total_fmt} evaluations, {elapsed}, at most {remaining} more{postfix}"
"""Format of a bar for work that usually ends long before the last step."""
_bars: weakref.WeakSet[tqdm[Any]] = weakref.WeakSet()


def bar(label: str, **options: Any) -> Callable[[Iterable[Any]], Iterable[Any]]:
    """Return a function that wraps an iterable with a bar on stderr, shown after 1 s; ``options`` go to tqdm.

    A file as stderr gets no bar.
    """
    from tqdm import tqdm

    options = {"delay": 1.0} | options | {"leave": False, "dynamic_ncols": True, "disable": not sys.stderr.isatty()}

    def wrap(items: Iterable[Any]) -> Iterable[Any]:
        shown = tqdm(items, desc=label, **options)
        _bars.add(shown)
        return shown

    return wrap


@contextmanager
def waiting(label: str, **options: Any) -> Iterator[None]:
    """Show ``label`` and the time since on stderr, from 1 s on, while the block runs; ``options`` go to tqdm."""
    ended = Event()

    def show() -> None:
        for _ in bar(label, bar_format="{desc}: {elapsed}", **options)(iter(partial(ended.wait, 0.5), True)):
            pass

    thread = Thread(target=show, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def close_bars() -> None:
    """Remove all bars, so that a message gets a separate line; an error may have left some."""
    for each in list(_bars):
        each.close()
