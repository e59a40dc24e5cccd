"""File from which a search or a fit resumes: its state, the inputs that it depends on, and a digest of both.

The inputs are the key: work resumes only under equal ones, and an error names those that differ.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from batchpid.arrays.array_types import Document
from batchpid.arrays.digest import digest
from batchpid.checks.validate import file_path
from batchpid.errors import InvalidArgumentError
from batchpid.io.files import write_atomically
from batchpid.io.versions import package_versions
from batchpid.sim.runner_keywords import DEFAULT_ENGINE

Value = TypeVar("Value")
REMEDY = "use the same inputs, remove it, or name another file"
"""Remedy where a file is of other work."""


class HistoryFile:
    """File with the state of a ``kind`` of work, "search" or "fit", that depends on ``settings``, plain values.

    Nothing is kept if ``path`` is None. Raises InvalidArgumentError if the file exists, and is damaged or has other
    settings, which the message names.
    """

    def __init__(self, path: Path | str | None, kind: str, settings: Mapping[str, Any]) -> None:
        self._path, self._kind = None if path is None else file_path("history", path), kind
        self._settings = json.loads(json.dumps(dict(settings)))
        self._found: Any = None
        if self._path is not None and self._path.exists():
            theirs, self._found = self._checked(self._read)
            if (problem := other_inputs(kind, theirs, self._settings)) is not None:
                raise self._error(problem)

    def state(self, parse: Callable[[Any], Value]) -> Value | None:
        """Return the state that the file had, as ``parse`` makes it from plain values; None if there was no file.

        Raises InvalidArgumentError if ``parse`` raises an error: the state is impossible under these settings.
        """
        return None if self._found is None else self._checked(lambda: parse(self._found))

    def write(self, state: Any) -> None:
        """Write the file with a ``state`` of plain values; its folder is made if there is none."""
        if self._path is not None:
            state = json.loads(json.dumps(state))
            self._path.parent.mkdir(parents=True, exist_ok=True)
            document = {"settings": self._settings, "state": state, "digest": digest(self._settings, state)}
            write_atomically(self._path, json.dumps(document))

    def _read(self) -> tuple[Document, Any]:
        """Return the settings and the state in the file."""
        assert self._path is not None
        document = json.loads(self._path.read_bytes())
        theirs, state = dict(document["settings"]), document["state"]
        if document["digest"] != digest(theirs, state):
            raise ValueError("it was damaged or edited")
        return theirs, state

    def _checked(self, read: Callable[[], Value]) -> Value:
        """Return the result of ``read``, whose errors mean that the file is damaged."""
        try:
            return read()
        except (OSError, ValueError, LookupError, TypeError, AttributeError, OverflowError, RecursionError) as error:
            reason = error if isinstance(error, OSError | ValueError) else type(error).__name__
            raise self._error(f"is not a history of a {self._kind}: {reason}") from None

    def _error(self, problem: str) -> InvalidArgumentError:
        return InvalidArgumentError("history", problem, value=str(self._path), remedy=REMEDY)


def other_inputs(kind: str, theirs: Mapping[str, Any], ours: Mapping[str, Any]) -> str | None:
    """Return what is wrong with a file of a ``kind`` of work whose inputs differ from ``ours``; None if none does."""
    different = {*theirs} ^ {*ours} | {key for key in {*theirs} & {*ours} if theirs[key] != ours[key]}
    return f"is of another {kind} ({', '.join(sorted(different))} differ)" if different else None


def plain_options(options: Mapping[str, Any], resumes: bool) -> Document:
    """Return options of the runner as plain values, and the versions of the packages that they use.

    Raises InvalidArgumentError for a function if the search ``resumes`` from a history.
    """
    libraries = options.get("engine", DEFAULT_ENGINE), *(("jax",) if options.get("backend") == "jax" else ())
    versions = package_versions(("batchpid", *libraries, "numpy", "cmaes"))
    return {name: _plain(name, value, resumes) for name, value in options.items()} | {"versions": versions}


def _plain(name: str, value: Any, resumes: bool) -> Any:
    """Return an option of the runner as a plain value: the option itself, its digest, or a function's name."""
    value = value.item() if isinstance(value, np.generic) else value
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if not callable(value):
        return digest(value)
    if resumes:
        problem = f"cannot tell whether {name} is the same function when the search resumes"
        raise InvalidArgumentError("history", problem, remedy="leave history out")
    return getattr(value, "__qualname__", type(value).__qualname__)
