"""Books of the calling process, changed by whole commands only.

A command is a transaction. It begins when its request is noted as pending; from then on it is completed, by this call
or, after an interrupt (Ctrl-C, or another exception of a signal handler), by the next one. Arguments are checked before
it begins. If a loop raises after that, the pool is closed, unless the request only reads. Its changes in this process
are a new value of the books, which a function makes from the value before and from the workers' results. That function
may be interrupted and called again, and a single assignment makes its value valid.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from typing import Any, Generic, TypeVar

from batchpid.errors import InUseError, WorkerError
from batchpid.sim.workers.pool import WorkerPool
from batchpid.sim.workers.requests import Request

Books = TypeVar("Books")
Commit = Callable[[Books, list[Any]], tuple[Books, Any]]
"""Function of the books before and of the workers' results; returns the books after and the result of the command."""


class Ledger(Generic[Books]):
    """Books of a pool's caller, and the command that is being executed.

    Parameters
    ----------
    pool
        Executes the requests.
    books
        First value.
    """

    def __init__(self, pool: WorkerPool, books: Books) -> None:
        self._pool = pool
        self.books = books
        """Immutable value; replaced when a command is complete."""
        self.cause: Exception | None = None
        """Error that closed the pool."""
        self._pending: tuple[Request, Books, Commit[Books]] | None = None  # with the books before
        self._owner, self._user = os.getpid(), 0  # the process, and the thread in a call

    @property
    def in_use(self) -> bool:
        """True during a call, and in a forked child."""
        return self._user != 0 or os.getpid() != self._owner

    @property
    def is_settled(self) -> bool:
        """True if no command is being executed, or was interrupted, and this is not a forked child."""
        return self._pending is None and not self._user and os.getpid() == self._owner

    def execute(self, request: Request, commit: Commit[Books], publish: Callable[[], None]) -> Any:
        """Let every worker execute its part of ``request``, then ``commit``; return the result of the command.

        ``publish`` passes on what is new in the books, before the command and after it. It may be interrupted.

        Raises
        ------
        WorkerError
            A worker was lost for good; the pool is closed.
        Exception
            A loop raised it; the pool is closed, unless the request only reads.
        InUseError
            Another call is in progress, or the pool belongs to another process.
        ClosedError
            The pool was closed meanwhile.
        """
        return self._exclusive(lambda: self._execute(request, commit, publish))

    def begin(self, request: Request, commit: Commit[Books], publish: Callable[[], None]) -> None:
        """Send every worker its part of ``request``, as a pending command; raises as :meth:`execute` does."""
        self._exclusive(lambda: self._begin(request, commit, publish))

    def settle(self, publish: Callable[[], None]) -> None:
        """Complete a command that was begun, or whose call was interrupted; raises as :meth:`execute` does.

        An error in an interrupted command that only reads is dropped.
        """
        self._exclusive(lambda: self._settle(publish))

    def close(self) -> None:
        """End all workers; a loop in this process ends after the running call. May be called again."""
        self._pool.closed = True
        if not (self._user and self._pool.is_local):  # its scenes are still in use
            self._pool.close()

    def _execute(self, request: Request, commit: Commit[Books], publish: Callable[[], None]) -> Any:
        if self._pending is not None:
            self._settle(publish)
        self._pending = request.copy(), self.books, commit
        result = self._complete(*self._pending)
        publish()
        return result

    def _begin(self, request: Request, commit: Commit[Books], publish: Callable[[], None]) -> None:
        if self._pending is not None:
            self._settle(publish)
        self._pending = request.copy(), self.books, commit
        self._guarded(self._pool.begin, self._pending[0])

    def _settle(self, publish: Callable[[], None]) -> None:
        if self._pending is not None and not self._pool.closed:
            try:
                self._complete(*self._pending)
            except Exception:
                if self._pool.closed or self._pending is not None:
                    raise
        publish()

    def _complete(self, request: Request, before: Books, commit: Commit[Books]) -> Any:
        results = self._guarded(self._pool.run, request)
        failure, result = self._pool.failure, None
        if failure is None or request.counts_ticks:
            self.books, result = commit(before, results)
        self._pending = None
        if failure is not None:
            if request.changes_loop:
                self.cause = failure.error
                self.close()
            raise failure.error
        return result

    def _guarded(self, function: Callable[[Request], Any], request: Request) -> Any:
        """Return ``function(request)``; close the pool if a worker was lost for good."""
        try:
            return function(request)
        except WorkerError as error:
            self.cause = error
            self.close()
            raise

    def _exclusive(self, call: Callable[[], Any]) -> Any:
        """Return ``call()``; raise InUseError if another call is in progress."""
        me, mine = threading.get_ident(), False
        try:
            if os.getpid() != self._owner:
                raise InUseError(
                    f"this Runner belongs to process {self._owner}, from which this one was forked; use it there, or "
                    "make one here"
                )
            if self._user:
                raise InUseError(
                    "this Runner is in a call that this one interrupted; let a signal handler set a flag, or close it"
                    if self._user == me
                    else "this Runner is in a call from another thread; take turns, or make one for each thread"
                )
            # There is no call between the check and here, so that neither a thread nor a signal can come in between.
            self._user, mine = me, True
            return call()
        finally:
            if mine:
                self._user = 0
                if self._pool.closed:
                    self.close()
