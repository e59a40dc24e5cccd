"""Exclusive use of a runner by one call at a time; Ctrl-C waits until the request of the call is
done.
"""

from __future__ import annotations

# The module signal makes enums of handlers, which takes a twentieth of a tick.
import _signal
import os
import threading
from signal import SIGINT
from types import FrameType
from typing import Any

from batchpid.errors import InUseError


class OneCall:
    """Use of a runner by one call at a time, from :meth:`begin` to :meth:`end`.

    In the main thread SIGINT is held back during the call: its handler, which may raise
    KeyboardInterrupt, is called in :meth:`end`. So a request to the workers is completed, and so is
    the change of the runner's state. A second SIGINT is not held back while :attr:`waits` is set;
    if its handler raises, the request is not completed, and the runner must be closed.
    """

    def __init__(self) -> None:
        self.waits = False
        """True while the call waits for workers, or runs the loop in this process."""
        self._owner, self._main = os.getpid(), threading.main_thread().ident
        self._user = 0  # identifier of the thread in a call
        self._handler: Any = None  # of SIGINT, while it is replaced
        self._is_held = False

    @property
    def in_use(self) -> bool:
        """True during a call, and in a forked child."""
        return self._user != 0 or os.getpid() != self._owner

    def check(self) -> None:
        """Raise InUseError if another call is in progress, or the runner belongs to another
        process.
        """
        if self.in_use:
            raise self._refusal(threading.get_ident(), os.getpid())

    def begin(self) -> None:
        """Begin a call. Raises as :meth:`check`."""
        me = threading.get_ident()
        process = os.getpid()
        if self._user or process != self._owner:
            raise self._refusal(me, process)
        # No function was called since the check. CPython switches threads and calls signal handlers
        # at calls of functions and at jumps back alone, so none can run in between.
        self._user = me
        self._handler = None
        self._is_held = False
        # The handler is None where it is not one of Python.
        if me == self._main and _signal.getsignal(SIGINT) is not None:
            try:
                self._handler = _signal.signal(SIGINT, self._on_interrupt)
            # An error of the handler, for a SIGINT that came before.
            except BaseException:
                self._user = 0
                raise

    def end(self) -> None:
        """End the call; then call the handler of a SIGINT that was held back."""
        self._user = 0
        self.waits = False
        handler = self._handler
        if handler is not None:
            _signal.signal(SIGINT, handler)
            if self._is_held:
                _signal.raise_signal(SIGINT)

    def _on_interrupt(self, number: int, frame: FrameType | None) -> None:
        is_second, self._is_held = self._is_held, True
        if is_second and self.waits:
            self._is_held = False
            if callable(self._handler):
                self._handler(number, frame)
            else:  # the system's, which ends the process
                _signal.signal(SIGINT, self._handler)
                _signal.raise_signal(SIGINT)

    def _refusal(self, me: int, process: int) -> InUseError:
        if process != self._owner:
            problem = f"belongs to process {self._owner}, from which this one was forked"
            return InUseError(f"this Runner {problem}; use it there, or make one here")
        if self._user == me:
            remedy = "let a signal handler set a flag, or close it"
            return InUseError(f"this Runner is in a call that this one interrupted; {remedy}")
        remedy = "take turns, or make one for each thread"
        return InUseError(f"this Runner is in a call from another thread; {remedy}")
