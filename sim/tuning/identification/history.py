"""History of a fit: its state after each step, in a file from which it resumes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from batchpid.errors import InvalidArgumentError
from batchpid.files import write_atomically
from sim.tuning.identification.fit import State


class History:
    """State of a fit after each step, kept in a file unless ``path`` is None; read from it if it exists."""

    def __init__(self, path: Path | str | None, settings: dict[str, Any]) -> None:
        self.state: State | None = None
        self._path, self._settings = path, json.loads(json.dumps(settings))
        if path is None or not Path(path).exists():
            return
        try:
            document = json.loads(Path(path).read_text())
            theirs = document["settings"]
            self.state = State(np.array(document["theta"], float), float(document["damping"]), int(document["step"]))
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
            document = {"settings": self._settings, "theta": state.theta.tolist()}
            document |= {"damping": state.damping, "step": state.step}
            write_atomically(self._path, json.dumps(document))
