"""Functions that run in a background thread, where no signal interrupts them.

Python runs signal handlers in the main thread, between any two operations. An exception that a handler raises, such as
KeyboardInterrupt, can therefore come after a file was opened or a process started, and before anyone has noted that.
In another thread this cannot happen. The thread that waits for the result can be interrupted, and wait again.
"""

from __future__ import annotations

import _thread
import contextlib
from collections.abc import Callable
from contextvars import copy_context
from queue import Empty, SimpleQueue
from typing import Generic, TypeVar

T = TypeVar("T")


class Job(Generic[T]):
    """Function that is called once, by :meth:`run`, and whose result others wait for.

    It sees the context variables of the thread that made the job.
    """

    def __init__(self, function: Callable[[], T]) -> None:
        self._function, self._context = function, copy_context()
        self._outcome: tuple[T | None, BaseException | None] | None = None
        self._wake: SimpleQueue[None] = SimpleQueue()

    @property
    def done(self) -> bool:
        """True when the function has returned or raised."""
        return self._outcome is not None

    def run(self) -> None:
        """Call the function."""
        try:
            self._outcome = self._context.run(self._function), None
        except BaseException as error:
            self._outcome = None, error
        self._wake.put(None)

    def result(self) -> T:
        """Wait for the end of the function; return its result, or raise its error. May be called again."""
        while self._outcome is None:
            with contextlib.suppress(Empty):  # an interrupted wait can have taken the item
                self._wake.get(timeout=1.0)
        result, error = self._outcome
        if error is not None:
            raise error
        return result  # type: ignore[return-value]


def start_thread(*functions: Callable[[], None]) -> None:
    """Call ``functions`` one after another in a new thread, which does not keep the program from ending.

    The constructor of :class:`threading.Thread` can be interrupted while it holds a lock that the new thread needs.
    """

    def run() -> None:
        for function in functions:
            function()

    _thread.start_new_thread(run, ())
