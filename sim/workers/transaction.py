"""State of a Runner in the calling process, which changes by transactions: one for each command.

A transaction begins when its request is noted. From then on it is completed, by this call or, after an interrupt
(Ctrl-C, or another exception of a signal handler), by the next one. Arguments are checked before it begins. If a loop
raises after that, the pool is closed, unless the request only reads. The new state is the value of a function of the
state before and of the workers' results. That function may be interrupted and called again, and a single assignment
makes its value valid.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from enum import Enum
from typing import Any, NamedTuple

from numpy.typing import NDArray

import batchpid as bp
from batchpid.errors import CallOrderError, ClosedError, InUseError, WorkerError
from batchpid.sim.loop.faults import FaultLog
from batchpid.sim.observation import Observation
from batchpid.sim.randomization.draws import Draws
from batchpid.sim.workers.contact_log import MissedContactLog
from batchpid.sim.workers.pool import WorkerPool
from batchpid.sim.workers.requests import Request


class Phase(Enum):
    """Phase of a runner's last command."""

    IDLE = "idle"
    """Complete."""
    BEGUN = "begun"
    """Sent by :meth:`Runner.send`, in progress, or interrupted: the next call completes it."""
    UNRECEIVED = "unreceived"
    """Complete, and :meth:`Runner.recv` has not yet returned the observation of the last tick that was sent."""


class RunnerState(NamedTuple):
    """Everything about a runner that its commands change, apart from the workers."""

    params: bp.PIDParams
    faults: FaultLog
    draws: Draws
    steps: int = 0
    steps_since_checkpoint: int = 0
    work: tuple[tuple[float, ...], int] = ((), 1)
    """Seconds of each worker in the last run, and the ticks of that run."""
    unrecorded: tuple[tuple[float, NDArray[Any], Observation, bool], ...] = ()
    """Ticks for the recorder: time [s], setpoint, observation, and whether the setpoint had rates."""
    actuators: bp.Actuators | None = None
    contacts: MissedContactLog | None = None
    """None with collisions."""
    sent: Observation | None = None
    """Observation of the last tick that :meth:`Runner.send` began."""
    targets: NDArray[Any] | None = None
    """Last joint setpoints (envs, dof), where searches for poses of the tool start; None without such poses."""
    motion: tuple[NDArray[Any], NDArray[Any] | None] | None = None
    """Setpoint of the last tick and its rate (envs, dof), None for 0; after a reset positions and velocities.

    None where setpoints are not those of joints.
    """


Commit = Callable[[RunnerState, list[Any]], tuple[RunnerState, Any]]
"""Function of the state before and of the workers' results; returns the state after and the result of the command."""


def read_only(state: RunnerState, results: list[Any]) -> tuple[RunnerState, list[Any]]:
    """Commit of a command that changes nothing; its result is the list of the workers' results."""
    return state, results


class Transactions:
    """State of a pool's caller, and the transaction that changes it.

    Parameters
    ----------
    pool
        Executes the requests.
    state
        First state.
    publish
        Passes on ``state.unrecorded``, before a command and after it. It may be interrupted.
    """

    def __init__(self, pool: WorkerPool, state: RunnerState, publish: Callable[[], None]) -> None:
        self._pool, self._publish = pool, publish
        self.state = state
        """Immutable; replaced when a command is complete."""
        self.phase = Phase.IDLE
        """Phase of the last command."""
        self.cause: Exception | None = None
        """Error that closed the pool."""
        self._last: tuple[Request, RunnerState, Commit, Phase] | None = None  # with the state before, and next phase
        self._owner, self._user = os.getpid(), 0  # the process, and the thread in a call

    @property
    def in_use(self) -> bool:
        """True during a call, and in a forked child."""
        return self._user != 0 or os.getpid() != self._owner

    def ready(self, call: str | None = None) -> RunnerState:
        """Complete an unfinished command, and return the state.

        ``call`` is the name of a method that changes the observation.

        Raises
        ------
        ClosedError
            The pool is closed.
        CallOrderError
            The observation of a tick that was sent has not been received, and ``call`` would change it.
        Exception
            As for :meth:`run`.
        """
        if self._pool.closed:
            reason = "" if self.cause is None else f", since a call failed ({str(self.cause).splitlines()[0]})"
            raise ClosedError(f"this Runner is closed{reason}; make a new one")
        if self.phase is Phase.BEGUN or self._user or os.getpid() != self._owner or self.state.unrecorded:
            self.run()
        if call is not None and self.phase is Phase.UNRECEIVED:
            problem = "the observation of the last tick that was sent has not been received"
            raise CallOrderError(f"{call}: {problem}; call recv() first")
        return self.state

    def run(self, request: Request | None = None, commit: Commit = read_only, *, wait: bool = True) -> Any:
        """Execute ``request`` on all workers, then ``commit``; return the result of the command.

        An unfinished command is completed first; without ``request`` nothing else is done, and an error in it is
        dropped if it only reads. Without ``wait`` the request is sent, for a later call to complete. The arrays of
        ``request`` must not change afterwards. Raises WorkerError if a worker was lost for good; the pool is closed.

        Exception
            A loop raised it; the pool is closed, unless the request only reads.
        InUseError
            Another call is in progress, or the pool belongs to another process.
        ClosedError
            The pool was closed meanwhile.
        """
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
            # Nothing is called between the check and here, so that neither a thread nor a signal can come in between.
            self._user, mine = me, True
            if request is None or self.phase is Phase.BEGUN:
                self._settle()
            if request is None:
                return None
            self._last = request, self.state, commit, self.phase if wait else Phase.UNRECEIVED
            self.phase = Phase.BEGUN
            if not wait:
                return self._pool.begin(request)
            result = self._complete()
            if self.state.unrecorded:
                self._publish()
            return result
        except WorkerError as error:
            if mine:
                self.cause = error
                self.close()
            raise
        finally:
            if mine:
                self._user = 0
                if self._pool.closed:
                    self.close()

    def close(self) -> None:
        """End all workers; a loop in this process ends after the running call. May be called again."""
        self._pool.closed = True
        if not (self._user and self._pool.is_local):  # its scenes are still in use
            self._pool.close()

    def _settle(self) -> None:
        if self.phase is Phase.BEGUN and not self._pool.closed:
            try:
                self._complete()
            except Exception:
                if self._pool.closed or self.phase is Phase.BEGUN:
                    raise
        self._publish()

    def _complete(self) -> Any:
        """Complete the command that was begun; return its result."""
        assert self._last is not None
        request, before, commit, after = self._last
        results = self._pool.run(request)
        failure, result = self._pool.failure, None
        if failure is None or request.counts_ticks:
            self.state, result = commit(before, results)
        self.phase = after
        if failure is not None:
            if request.changes_loop:
                self.cause = failure.error
                self.close()
            raise failure.error
        return result
