"""Errors of a loop during a request, in a form that does not depend on how envs are divided among
workers.
"""

from __future__ import annotations

import traceback
from typing import NamedTuple

from batchpid.errors import BatchPIDError, ControllerError, WorkerError


class Failure(NamedTuple):
    """Error of a loop during a request. Whole ticks before it are valid; the state of the loop
    after it is undefined.

    Of several failures, the first by :func:`order` is reported.
    """

    step: int
    """Sim step since the start of the runner; the first one of the tick if it is not known."""
    env: int
    """First env of the group that failed."""
    ticks: int
    """Ticks of the request that were completed before the error."""
    error: Exception

    def portable(self) -> Failure:
        """Return the failure with an error class of this project, which another process can raise,
        and the traceback.

        :meth:`of_worker` puts the name of the worker in front of the message of a WorkerError.
        """
        error = self.error
        text = "".join(traceback.format_exception(self.error))
        if isinstance(error, ControllerError):
            if not hasattr(
                error, "__notes__"
            ):  # a node of a cluster passes on the failure of its worker
                error.add_note(text)
        elif not isinstance(error, BatchPIDError):
            error = WorkerError(f"raised:\n{text}")
        return self._replace(error=error)

    def of_worker(self, name: str) -> Failure:
        """Return the failure with the name of its worker in front of the message of a
        WorkerError.
        """
        is_ours = type(self.error) is WorkerError
        if is_ours:
            return self._replace(error=WorkerError(f"{name} {self.error}"))
        return self


def order(failure: Failure) -> tuple[int, int]:
    """Return the key by which failures are sorted: the earliest sim step first, then the lowest
    env.
    """
    return failure.step, failure.env


class RunError(Exception):
    """A group of envs failed in :meth:`batchpid.sim.loop.loop.Loop.run`."""

    def __init__(self, failure: Failure) -> None:
        super().__init__(str(failure.error))
        self.failure = failure


def failure_of(error: Exception) -> Failure:
    """Return the failure in a RunError; for another exception of a loop, a failure at step 0."""
    if isinstance(error, RunError):
        return error.failure
    return Failure(0, 0, 0, error)
