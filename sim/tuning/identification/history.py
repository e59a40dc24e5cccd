"""History of a fit: its state before each step, in a file from which it resumes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from batchpid.errors import InvalidArgumentError
from batchpid.files import write_atomically
from sim.tuning.identification.fit import Step


class State(NamedTuple):
    """State of a search: all that the rest of it depends on."""

    step: Step
    """State of the fit that is being done."""
    done: tuple[tuple[int, list[float]], ...] = ()
    """Fits that were done: number of the problem, and solution."""


class History:
    """State of a fit before each step, kept in a file unless ``path`` is None; read from it if it exists."""

    def __init__(self, path: Path | str | None, settings: dict[str, Any]) -> None:
        self.state: State | None = None
        self._path, self._settings = path, json.loads(json.dumps(settings))
        if path is None or not Path(path).exists():
            return
        try:
            document = json.loads(Path(path).read_text())
            theirs = document["settings"]
            theta, last = (np.array(document[name], float) for name in ("theta", "last"))
            cost = np.inf if document["cost"] is None else float(document["cost"])
            self.state = State(
                Step(theta, int(document["left"]), last, cost),
                tuple((int(number), theta) for number, theta in document["done"]),
            )
            different = sorted(k for k in {*theirs, *self._settings} if theirs.get(k) != self._settings.get(k))
            problem = f"is of another fit ({', '.join(different)} differ)" if different else None
        except (ValueError, KeyError, TypeError) as error:
            problem = f"is no history of a fit: {error}"
        if problem is not None:
            remedy = "use the same options, remove it, or name another file"
            raise InvalidArgumentError("history", problem, value=str(path), remedy=remedy)

    def write(self, state: State) -> None:
        """Write the file."""
        if self._path is not None:
            theta, left, last, cost = state.step
            document = {
                "settings": self._settings,
                "theta": theta.tolist(),
                "left": left,
                "last": last.tolist(),
                "cost": cost if np.isfinite(cost) else None,
                "done": state.done,
            }
            write_atomically(self._path, json.dumps(document))
