"""History of a fit: its state before each step, in a file from which it resumes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from batchpid.sim.identification.fit import FitStep
from batchpid.sim.tuning.history import HistoryFile


class State(NamedTuple):
    """State of a search: all that the rest of it depends on."""

    step: FitStep
    """State of the fit that is being done."""
    done: tuple[tuple[int, list[float]], ...] = ()
    """Fits that were done: number of the problem, and solution."""


class History:
    """State of a fit before each step, kept in a file unless ``path`` is None.

    Raises InvalidArgumentError if the file exists, and is damaged or has other settings.
    """

    def __init__(self, path: Path | str | None, settings: Mapping[str, Any]) -> None:
        self._file = HistoryFile(path, "fit", settings)
        self._found = self._file.read()

    def state(self, unknowns: int, evaluations: int, problems: int) -> State | None:
        """Return the state in the file, or None if there was no file.

        Raises InvalidArgumentError if it does not fit the numbers of ``unknowns``, ``evaluations`` and ``problems``.
        """
        if (found := self._found) is None:
            return None
        try:
            theta, last = (np.array(found[name], float) for name in ("theta", "last"))
            done = tuple((int(number), [float(value) for value in point]) for number, point in found["done"])
            state = State(FitStep(theta, int(found["left"]), last, float(found["cost"])), done)
        except (ValueError, LookupError, TypeError, OverflowError) as error:
            raise self._file.damaged(str(error)) from None
        points = [theta, last, *(np.array(point) for _, point in done)]
        if not all(point.shape == (unknowns,) and np.isfinite(point).all() for point in points):
            raise self._file.damaged(f"its points are not {unknowns} finite numbers")
        if not 0 <= state.step.left <= evaluations or not all(0 <= number < problems for number, _ in done):
            raise self._file.damaged("its counts are out of range")
        return state

    def write(self, state: State) -> None:
        """Write the file."""
        theta, left, last, cost = state.step
        self._file.write(
            {"theta": theta.tolist(), "left": left, "last": last.tolist(), "cost": cost, "done": state.done}
        )
