"""File from which a search or a fit resumes: its state, the inputs that it depends on, and a digest of both."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Document
from batchpid.arrays.digest import digest
from batchpid.checks.validate import file_path
from batchpid.errors import InvalidArgumentError
from batchpid.io.files import write_atomically
from batchpid.io.versions import package_versions
from batchpid.sim.runner_keywords import DEFAULT_ENGINE

REMEDY = "use the same inputs, remove it, or name another file"
"""Remedy where a file is of other work."""


class HistoryFile:
    """File with the state of a ``kind`` of work, "search" or "fit", that depends on ``settings``, plain values.

    Nothing is kept if ``path`` is None.
    """

    def __init__(self, path: Path | str | None, kind: str, settings: Mapping[str, Any]) -> None:
        self._path, self._kind = None if path is None else file_path("history", path), kind
        self._settings = json.loads(json.dumps(dict(settings)))

    def read(self) -> Any:
        """Return the state in the file, None if there is no file.

        Raises InvalidArgumentError if the file is damaged, or its settings differ; the message names these.
        """
        if self._path is None or not self._path.exists():
            return None
        try:
            document = json.loads(self._path.read_bytes())
            theirs, state = document["settings"], document["state"]
            if document["digest"] != digest(theirs, state):
                raise ValueError("it was damaged or edited")
            problem = other_inputs(self._kind, theirs, self._settings)
        except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
            reason = error if isinstance(error, OSError | ValueError) else type(error).__name__
            raise self.damaged(str(reason)) from None
        if problem is not None:
            raise self._error(problem)
        return state

    def write(self, state: Any) -> None:
        """Write the file with a ``state`` of plain values."""
        if self._path is not None:
            state = json.loads(json.dumps(state))
            document = {"settings": self._settings, "state": state, "digest": digest(self._settings, state)}
            write_atomically(self._path, json.dumps(document))

    def damaged(self, problem: str) -> InvalidArgumentError:
        """Return the error for a state that is impossible under these settings."""
        return self._error(f"is not a history of a {self._kind}: {problem}")

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
