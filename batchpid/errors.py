"""Errors of batchpid, each with its data; warnings at the caller's line; and the base of objects
that cannot be copied.

A message says what is wrong, where (argument, joint, env), the value, and the remedy.
"""

from __future__ import annotations

import copyreg
import reprlib
import sys
import warnings
from types import FrameType
from typing import Any, ClassVar

_SHORT = reprlib.Repr()
_SHORT.maxstring, _SHORT.maxother = 500, 200
_INSIDE = ("batchpid.", "importlib.")


class BatchPIDError(Exception):
    """Root of the errors that this project raises on purpose."""


def _reduced(error: BatchPIDError) -> tuple[Any, ...]:
    """Pickle by message and fields, so that the error crosses process borders whole."""
    return copyreg.__newobj__, (type(error), *error.args), error.__dict__  # type: ignore[attr-defined]


class InvalidArgumentError(BatchPIDError, ValueError):
    """An argument has a wrong type, shape, dtype, range or a non-finite entry.

    Raised before anything is changed. ``argument``, ``joint``, ``entry``, ``env``, ``value`` and
    ``remedy`` hold the facts of the message, for programs; ``entry`` is the name in an array whose
    columns are not joints.
    """

    def __init__(
        self,
        argument: str,
        problem: str,
        *,
        remedy: str,
        joint: str | int | None = None,
        entry: str | int | None = None,
        env: int | None = None,
        value: object = None,
    ) -> None:
        self.argument = argument
        self.problem = problem
        self.remedy = remedy
        self.joint = joint
        self.entry = entry
        self.env = env
        self.value = value
        places = {"joint": joint, "entry": entry, "env": env}
        where = "".join(
            f", {kind} {place!r}" for kind, place in places.items() if place is not None
        )
        if value is None:
            got = ""
        else:
            got = f" (got {_SHORT.repr(value)})"
        super().__init__(f"{argument}{where}: {problem}{got}; {remedy}")

    __reduce__ = _reduced


class ControllerError(InvalidArgumentError):
    """The caller's own controller raised, or returned an unusable state or effort, in a sim step.

    It closes the runner. ``step`` counts sim steps within the tick, or, in an error returned by
    :meth:`at`, since the start of the runner. The controller's own error, if there is one, is the
    ``__cause__``; an error from a worker process has the traceback as a note.
    """

    def __init__(self, name: str, error: Exception, step: int) -> None:
        if isinstance(error, InvalidArgumentError):
            problem, remedy = error.problem, error.remedy
        else:
            problem = f"{name} raised {type(error).__name__}: {error}"
            remedy = "correct the controller"
        super().__init__("control", problem, remedy=remedy)
        self.step = step

    def at(self, step: int, timestep: float) -> ControllerError:
        """Return the error with a message that says when it happened: at ``step`` since the start
        of the runner.
        """
        when = f"in sim step {step} ({step * timestep:g} s)"
        problem = InvalidArgumentError(
            "control",
            f"{self.problem}, {when}",
            remedy=f"{self.remedy}, and make a new Runner: this one is closed",
        )
        error = ControllerError("", problem, step)
        error.__cause__ = self.__cause__
        return error


class RobotError(BatchPIDError, ValueError):
    """A robot description cannot be used; the message names the file, the element and the
    remedy.
    """


class RobotNotFoundError(RobotError, FileNotFoundError):
    """Neither a bundled robot nor a file of that name exists."""


class MissingDependencyError(BatchPIDError, ImportError):
    """A package is missing or too old; the message names the extra that installs it, if one
    does.
    """

    def __init__(self, package: str, purpose: str, extra: str | None = None) -> None:
        self.package = package
        self.purpose = purpose
        self.extra = extra
        # Extras come from a checkout, as long as batchpid is on no index.
        if extra is None:
            source = package
        else:
            source = f"'.[{extra}]' in the checkout of batchpid"
        super().__init__(
            f"{purpose} needs the package {package!r}; install it with: pip install {source}"
        )

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.package, self.purpose, self.extra)


class WorkerError(BatchPIDError, RuntimeError):
    """A worker process failed or died; the message names the worker, its envs and the cause."""


class ClosedError(BatchPIDError, RuntimeError):
    """The object was closed before this call."""


class NotCopyableError(BatchPIDError, TypeError):
    """The object owns processes, files or native memory, and can be neither copied nor pickled."""


class InUseError(BatchPIDError, RuntimeError):
    """The object is in use: by another thread, a signal handler, or the process from which this one
    was forked.
    """


class SingleOwner:
    """Base of objects that can be neither copied nor pickled: two would close each other's
    processes and files.
    """

    instead: ClassVar[str] = "make another one"
    """Alternative to a copy, for the error message."""

    def __reduce__(self) -> Any:
        """Refuse; copy.copy, copy.deepcopy and pickle call it.

        Raises
        ------
        NotCopyableError
            Always.
        """
        name = type(self).__name__
        raise NotCopyableError(
            f"a {name} can be neither copied nor pickled, since it owns processes, files or native"
            f" memory; {self.instead}"
        )


def warn(message: str, category: type[Warning]) -> None:
    """Issue a warning at the line of the caller's own program, however deep in batchpid it arises."""
    frame = sys._getframe(1)
    while frame.f_back is not None and _is_inside(frame):
        frame = frame.f_back
    place = frame.f_globals
    warnings.warn_explicit(
        message,
        category,
        frame.f_code.co_filename,
        frame.f_lineno,
        place.get("__name__", "sys"),
        place.setdefault("__warningregistry__", {}),
    )


def _is_inside(frame: FrameType) -> bool:
    return f"{frame.f_globals.get('__name__', '')}.".startswith(_INSIDE)
