"""Recorder: every tick of a runner streamed to an .h5 file that can be read at any time, even after a kill.

A thread makes the file, appends the recorded ticks every half second in HDF5's single-writer mode, and completes it. A
tick waits while the oldest row that is not on disk was recorded more than :data:`MAX_LAG` ago, so that a kill loses at
most a second's ticks, however slow the disk. The file grows as ``NAME.partial`` and gets its name when it is complete;
an existing file of that name is not touched before. See :mod:`batchpid.sim.recording.recording_files` for its
content.

The runner gives a completed tick to :meth:`Recorder.append`, which only queues it, and calls :meth:`Recorder.wait`
before the next: Ctrl-C interrupts the wait, in which nothing has begun, and loses no tick. It can interrupt the other
calls at any moment, but not the thread. So they take no lock that the thread needs, and can be repeated.
"""

from __future__ import annotations

import contextlib
import math
import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from batchpid.checks.single_owner import SingleOwner
from batchpid.checks.validate import flag, instance, integer
from batchpid.errors import BatchPIDError, ClosedError, InUseError, InvalidArgumentError
from batchpid.sim.loop.faults import Fault
from batchpid.sim.observation import RECORDED, Observation, Redraw
from batchpid.sim.processes.background import Job, start_thread
from batchpid.sim.recording import recording_files as files
from batchpid.sim.recording.partial_file import PartialFile
from batchpid.sim.recording.recording_files import RecordingError

if TYPE_CHECKING:
    from batchpid.sim.runner import Runner

WRITE_PERIOD = 0.5
"""Time from one write to the next [s]."""
MAX_LAG = 0.75
"""Age of the oldest row that is not on disk at which the next tick waits for it [s]."""
MAX_BUFFER = 64 << 20
"""Bytes that may wait to be written."""
_RETRY = 0.002  # seconds between two looks whether a tick may go on


class _Row(NamedTuple):
    recorded: float
    """Time of the call [s]."""
    time: float
    setpoint: NDArray[Any]
    observation: Observation


class Recorder(SingleOwner):
    """Recorder of every tick of ``runner`` until it is closed.

    Parameters
    ----------
    path
        File to write, ending in .h5 or .hdf5.
    runner
        Runner to record.
    seed
        Seed of the run, if it has one; kept in the recording.
    overwrite
        Whether a complete recording replaces an existing file of that name, at the end.

    Raises
    ------
    InvalidArgumentError
        The file exists, its name ends otherwise, or another Recorder records the runner.
    ClosedError
        The runner is closed.
    MissingDependencyError
        h5py is not installed.
    RecordingError
        The file cannot be made.
    """

    instead = "close it, and record the next run with another Recorder"

    def __init__(
        self, path: str | os.PathLike[str], runner: Runner, *, seed: int | None = None, overwrite: bool = False
    ) -> None:
        from batchpid.sim.runner import Runner  # loads SAPIEN, as the runner has done already

        if instance("runner", runner, Runner, "pass the runner to record").closed:
            raise ClosedError("this Runner is closed; record one that is not")
        if runner.recorder is not None:
            raise InvalidArgumentError(
                "runner", f"is being recorded already, to {runner.recorder.path}", remedy="close that Recorder first"
            )
        overwrite, self._runner = flag("overwrite", overwrite), runner
        self.path: Path = files.check_path(path, files.HDF5, overwrite=overwrite)
        self.partial: Path = _free_name(self.path)
        seed = None if seed is None else integer("seed", seed, 0, 2**63 - 1)
        info = replace(runner.info, seed=seed, complete=False)
        files.load_h5py()
        seen = [table.nbytes for table in runner.observe() if table is not None]
        self._row_bytes = sum(seen) + 8 * runner.num_envs * runner.command.size
        self._rows: SimpleQueue[_Row | None] = SimpleQueue()  # None: the end
        self._wake: SimpleQueue[None] = SimpleQueue()  # ends the pause between two writes
        self._oldest = math.inf  # when the oldest row was recorded that is being written
        self._faults: tuple[Fault, ...] = runner.faults  # up to the last row
        self._episodes, self._redraws = runner.episodes, list[Redraw]()
        self._rates = False  # whether a recorded tick had rates
        self._end: Callable[[PartialFile], None] | None = None
        self._error: RecordingError | None = None
        self._has_raised = False
        tick = runner.timestep * runner.substeps
        self._creation = creation = Job(
            lambda: PartialFile(self.path, self.partial, info, runner.num_envs, tick, overwrite=overwrite)
        )
        self._writing = writing = Job(self._write_rows)
        try:
            start_thread(creation.run, writing.run)
            creation.result()
            runner.recorder = self
        except BaseException:
            self._finish_with(PartialFile.discard)
            raise

    def wait(self) -> None:
        """Return when the next tick may begin: the oldest row that is not on disk is not too old. The runner calls it.

        Raises
        ------
        RecordingError
            The ticks before could not be written.
        """
        while not self._writing.done and (self._is_full() or time.monotonic() - self._oldest > MAX_LAG):
            self._wake.put(None)
            time.sleep(_RETRY)
        self._check()

    def append(self, time_: float, setpoint: NDArray[Any], observation: Observation, has_rates: bool) -> None:
        """Record the state at ``time_`` [s], reached under ``setpoint`` (envs, size), with rates or without.

        The runner calls it, and Ctrl-C waits until it has returned.
        """
        self._faults, episodes = self._runner.faults, self._runner.episodes
        for env in np.flatnonzero((episodes != self._episodes).any(1)).tolist():
            self._redraws.append(Redraw(time_, env, *episodes[env].tolist()))
        self._episodes = episodes
        self._rates |= has_rates
        self._rows.put(_Row(time.monotonic(), time_, np.array(setpoint), observation))

    def close(self, complete: bool = True) -> None:
        """Write the remaining rows and give the file its name. May be called again, as after an interrupt.

        If the recording is to be ``complete``, a tick whose call was interrupted is completed first. One that is not
        keeps its partial name where a file of that name exists.
        """
        runner, failure = self._runner, None
        if runner.recorder is self:
            if complete:
                try:
                    runner.settle()
                except (InUseError, RecordingError):
                    pass  # the tick of a call in another thread is not recorded; an error of the disk is raised below
                except BatchPIDError as error:
                    failure = error
                self._faults = runner.faults
            runner.recorder = None
        faults, redraws = files.faults_text(self._faults), files.redraws_text(self._redraws)
        self._finish_with(lambda file: file.finish(complete, faults, redraws, self._rates))
        try:
            self._writing.result()
            self._check()
        except RecordingError:
            if self._has_raised:
                return
            self._has_raised = True
            raise
        if failure is not None:
            raise failure

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.close(complete=kind is None)

    def _check(self) -> None:
        if self._error is not None:
            raise self._error

    def _finish_with(self, end: Callable[[PartialFile], None]) -> None:
        """Make the thread write the remaining rows and call ``end``; only the first ``end`` counts."""
        if self._end is None:
            self._end = end
        self._rows.put(None)
        self._wake.put(None)

    def _is_full(self) -> bool:
        return self._rows.qsize() * self._row_bytes > MAX_BUFFER

    # -- in the thread -----------------------------------------------------------------------------------------------

    def _write_rows(self) -> None:
        """Write the recorded rows every half second until the end, and end the file."""
        try:
            file = self._creation.result()
        except Exception:
            return  # the constructor raises it
        try:
            while (first := self._rows.get()) is not None:
                self._oldest = first.recorded
                self._pause()
                rows = [(row.time, row.setpoint, *row.observation) for row in (first, *self._take_rows())]
                columns = zip(("time", *RECORDED), zip(*rows, strict=True), strict=True)
                file.append({name: np.array(column) for name, column in columns if column[0] is not None})
                self._oldest = math.inf
        except RecordingError as error:
            self._error = error
            return
        assert self._end is not None
        self._end(file)

    def _pause(self) -> None:
        """Wait for the time of the next write."""
        with contextlib.suppress(Empty):
            while True:  # of the last pause
                self._wake.get_nowait()
        if self._end is None and not self._is_full():
            with contextlib.suppress(Empty):
                self._wake.get(timeout=WRITE_PERIOD)

    def _take_rows(self) -> list[_Row]:
        rows = []
        for _ in range(self._rows.qsize()):
            row = self._rows.get()
            if row is None:
                self._rows.put(None)
                break
            rows.append(row)
        return rows


def _free_name(path: Path) -> Path:
    """Return the first of ``NAME.partial``, ``NAME.partial2``, ... that does not exist."""
    names = (path.with_name(f"{path.name}.partial{number}") for number in ("", *range(2, 10**6)))
    return next(name for name in names if not os.path.lexists(name))
