"""Output of the commands: files, with default names and checks before the run, and progress bars.

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
from typing import TYPE_CHECKING, Any, TypeVar

from batchpid.checks.validate import file_path
from batchpid.errors import InvalidArgumentError
from batchpid.io.files import write_atomically

if TYPE_CHECKING:
    from tqdm import tqdm

FOLDER = Path("out")
"""Folder of default outputs, which is made when a file is written; other folders have to exist."""
OUTPUTS = ("out", "picture", "json", "film", "corrected_urdf")
"""Flags that name output files."""
P = TypeVar("P", bound=Path | None)


class OutputFiles:
    """Output files of one run of a ``command``. With ``--force`` they replace files, but none that
    the command reads.

    The command reads the file that any other flag names.
    """

    def __init__(self, command: Any) -> None:
        self._force: bool = command.force
        self._outputs = list[str]()
        self._inputs = list[str | Path]()
        for name, value in vars(command).items():
            if name not in OUTPUTS:
                values = value if isinstance(value, tuple) else (value,)
                self._inputs += [
                    path for path in values if isinstance(path, str | Path) and os.path.isfile(path)
                ]

    def path(self, argument: str, path: P, suffixes: Collection[str]) -> P:
        """Return ``path`` after a check that a file may be written there; None is returned as None.

        Raises InvalidArgumentError if its suffix is not one of ``suffixes``, its folder neither
        exists nor is :data:`FOLDER`, the command reads it or writes it as another output, or it
        exists and may not be replaced.
        """
        if path is None:
            return path
        file_path(argument, path, suffixes)
        problem, remedy = None, "choose another file"
        exists = os.path.lexists(path)
        if os.path.exists(path) and any(os.path.samefile(path, source) for source in self._inputs):
            problem = "is a file to read"
        elif os.path.realpath(path) in self._outputs:
            problem = "is another output of this run"
        elif not path.parent.exists() and path.parent != FOLDER:
            folder = str(path.parent)
            problem, remedy = (
                f"has no folder {folder!r}",
                f"make it: mkdir -p {shlex.quote(folder)}",
            )
        elif exists and not self._force:
            problem, remedy = "exists already", "add --force to replace it, or choose another name"
        if problem is not None:
            raise InvalidArgumentError(argument, problem, value=str(path), remedy=remedy)
        self._outputs.append(os.path.realpath(path))
        return path


def write_figures(path: Path, figures: Any) -> None:
    """Write figures as JSON: arrays as lists, named tuples and mappings as objects, null for NaN
    and infinity.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, json.dumps(_plain(figures), indent=1, allow_nan=False) + "\n")


def _plain(value: Any) -> Any:
    value = (
        value._asdict()
        if hasattr(value, "_asdict")
        else value.tolist()
        if hasattr(value, "tolist")
        else value
    )
    if isinstance(value, Mapping):
        return {name: _plain(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def beside(path: Path, shown: str, suffix: str = ".png") -> Path:
    """Return the default path of a picture or film of ``path``, in the same folder:
    NAME-SHOWN.png.
    """
    return path.with_name(f"{path.stem}-{shown}{suffix}")


AT_MOST = (
    "{desc}: {n_fmt} of at most {total_fmt} evaluations, {elapsed}, at most {remaining}"
    " more{postfix}"
)
"""Format of a bar for work that usually ends long before the last step."""
_bars: weakref.WeakSet[tqdm[Any]] = weakref.WeakSet()


def bar(label: str, **options: Any) -> Callable[[Iterable[Any]], Iterable[Any]]:
    """Return a function that wraps an iterable with a bar on stderr, shown after 1 s; ``options``
    go to tqdm.

    A file as stderr gets no bar.
    """
    from tqdm import tqdm

    options = (
        {"delay": 1.0}
        | options
        | {"leave": False, "dynamic_ncols": True, "disable": not sys.stderr.isatty()}
    )

    def wrap(items: Iterable[Any]) -> Iterable[Any]:
        shown = tqdm(items, desc=label, **options)
        _bars.add(shown)
        return shown

    return wrap


def close_bars() -> None:
    """Remove all bars, so that a message gets a separate line; an error may have left some."""
    for open_bar in list(_bars):
        open_bar.close()
