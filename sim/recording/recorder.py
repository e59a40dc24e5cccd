"""Recorder: every tick of a runner streamed to an .h5 file that can be read at any time, even after a kill.

A thread makes the file, appends the recorded ticks every half second in HDF5's single-writer mode, and completes it. A
tick waits while the oldest row that is not on disk was recorded more than :data:`MAX_LAG` ago, so that a kill loses at
most a second's ticks, however slow the disk. The file grows as ``NAME.partial`` and gets its name when it is complete;
an existing file of that name is not touched before. See :mod:`sim.recording.files` for what it holds.

A signal handler (Ctrl-C) can interrupt the calls at any moment, but not the thread. So the calls take no lock that the
thread needs: they put items into queues that are written in C, and wait in ways that can be repeated.
"""

from __future__ import annotations

import contextlib
import errno
import math
import os
import re
import time
from collections import deque
from dataclasses import replace
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from batchpid.errors import BatchPIDError, ClosedError, InUseError, InvalidArgumentError
from batchpid.validate import flag, instance, integer
from sim.loop.faults import Fault
from sim.observation import RECORDED, Observation, RunInfo
from sim.recording import files
from sim.recording.files import RecordingError
from sim.workers.background import Job, start_thread

if TYPE_CHECKING:
    import h5py

    from sim.runner import Runner

WRITE_PERIOD = 0.5
"""Time from one write to the next [s]."""
MAX_LAG = 0.75
"""Age of the oldest row that is not on disk at which the next tick waits for it [s]."""
METADATA_BYTES = 1 << 18
"""Disk space that is kept for what HDF5 notes about the next rows."""
MAX_BUFFER = 64 << 20
"""Bytes that may wait to be written."""
_RETRY = 0.002  # seconds between two looks whether a tick may go on


class _Row(NamedTuple):
    recorded: float
    """Time of the call [s]."""
    time: float
    setpoint: NDArray[Any]
    observation: Observation


class _End(NamedTuple):
    """End of a recording."""

    complete: bool = False
    faults: str = ""
    discard: bool = False
    """Remove the file."""


class Recorder:
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

    def __init__(
        self, path: str | os.PathLike[str], runner: Runner, *, seed: int | None = None, overwrite: bool = False
    ) -> None:
        from sim.runner import Runner  # loads SAPIEN, as the runner has done already

        if instance("runner", runner, Runner, "pass the runner to record").closed:
            raise ClosedError("this Runner is closed; record one that is not")
        if runner.recorder is not None:
            raise InvalidArgumentError(
                "runner", f"is being recorded already, to {runner.recorder.path}", remedy="close that Recorder first"
            )
        self._overwrite, self._runner = flag("overwrite", overwrite), runner
        self.path: Path = files.check_path(path, files.HDF5, overwrite=overwrite)
        self.partial: Path = _free_name(self.path)
        seed = None if seed is None else integer("seed", seed, 0, 2**63 - 1)
        info = replace(runner.info, seed=seed, complete=False)
        files.load_h5py()
        self._row_bytes = sum(table.nbytes for table in runner.observe()) + 8 * runner.num_envs * runner.robot.dof
        self._rows: SimpleQueue[_Row | None] = SimpleQueue()  # None: the end
        self._wake: SimpleQueue[None] = SimpleQueue()  # ends the pause between two writes
        self._oldest = math.inf  # when the oldest row was recorded that is being written
        self._faults: deque[Fault] = runner.faults  # up to the last row
        self._end: _End | None = None
        self._error: Exception | None = None
        self._has_raised = False
        self._creation = creation = Job(lambda: self._create(info))
        self._writing = writing = Job(self._write_rows)
        try:
            start_thread(creation.run, writing.run)
            creation.result()
            runner.recorder = self
        except BaseException:
            self._finish_with(_End(discard=True))
            raise

    def append(self, time_: float, setpoint: NDArray[Any], observation: Observation) -> None:
        """Record the state at ``time_`` [s], reached under ``setpoint`` (envs, dof). The runner calls it.

        Repeated with the same ``observation``, after an interrupt, it has no effect.
        """
        while not self._writing.done and (self._is_full() or time.monotonic() - self._oldest > MAX_LAG):
            self._wake.put(None)
            time.sleep(_RETRY)
        self._check()
        self._faults = self._runner.faults
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
                    pass  # the tick of a call in another thread is not recorded; what the disk said is raised below
                except BatchPIDError as error:
                    failure = error
                self._faults = runner.faults
            runner.recorder = None
        self._finish_with(_End(complete, files.faults_text(self._faults)))
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
            raise RecordingError(
                f"{self.partial}: cannot be written: {_cause(self._error)}; what was recorded before can be read"
            ) from self._error

    def _finish_with(self, end: _End) -> None:
        """Let the thread end the recording; the first ``end`` counts."""
        if self._end is None:
            self._end = end
        self._rows.put(None)
        self._wake.put(None)

    def _is_full(self) -> bool:
        return self._rows.qsize() * self._row_bytes > MAX_BUFFER

    # -- in the thread -----------------------------------------------------------------------------------------------

    def _create(self, info: RunInfo) -> tuple[h5py.File, dict[str, h5py.Dataset]]:
        h5py, runner = files.load_h5py(), self._runner
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            file = h5py.File(self.partial, "x", libver="latest", rdcc_nbytes=files.CHUNK_BYTES, rdcc_w0=1.0)
            try:
                self._reserve(0)
                datasets = files.create_datasets(file, info, runner.num_envs, runner.timestep * runner.substeps)
                file.flush()
                file.swmr_mode = True
            except BaseException:
                _redirect_to_memory(file)
                with contextlib.suppress(Exception):
                    file.close()
                self.partial.unlink()
                raise
        except (OSError, RuntimeError) as error:
            if not isinstance(error, FileExistsError):  # on a full disk HDF5 leaves an empty file
                self.partial.unlink(missing_ok=True)
            raise RecordingError(f"{self.partial}: cannot be made: {_cause(error)}") from error
        return file, datasets

    def _reserve(self, end: int, size: int = 0) -> None:
        """Allocate disk space after ``end`` for ``size`` bytes of rows: HDF5 can crash after a write that failed."""
        chunk = max(files.CHUNK_BYTES, 8 * self._runner.num_envs * self._runner.robot.dof)
        size += 2 * len(files.DTYPES) * chunk + METADATA_BYTES  # a chunk of each dataset is not full
        with self.partial.open("r+b") as disk:
            try:
                os.posix_fallocate(disk.fileno(), end, size)
            except OSError as error:
                if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO):
                    raise  # with another error the file system does not offer it

    def _write_rows(self) -> None:
        """Write the recorded rows every half second until the end, and end the file."""
        try:
            file, datasets = self._creation.result()
        except Exception:
            return  # it is raised by the constructor
        try:
            last: Observation | None = None
            while (first := self._rows.get()) is not None:
                self._oldest = first.recorded
                self._pause()
                rows = []
                for row in (first, *self._take_rows()):
                    if row.observation is not last:  # otherwise the first of two calls was interrupted
                        rows.append((row.time, row.setpoint, *row.observation))
                    last = row.observation
                columns = map(np.array, zip(*rows, strict=True))
                if rows:
                    arrays = dict(zip(("time", *RECORDED), columns, strict=True))
                    self._reserve(file.id.get_filesize(), sum(array.nbytes for array in arrays.values()))
                    files.append_rows(datasets, arrays)
                self._oldest = math.inf
        except Exception as error:
            _redirect_to_memory(file)
            self._error = error
        size = file.id.get_filesize()
        with contextlib.suppress(Exception):  # the error before, if any, is the one to raise
            file.close()
        if self._end is not None and self._error is None:
            if self._end.discard:
                self.partial.unlink()
            else:
                self._complete(self._end, size)

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

    def _complete(self, end: _End, size: int) -> None:
        try:
            self._reserve(size, len(end.faults))
            # Without a lock, because a reader may hold one.
            with files.load_h5py().File(self.partial, "r+", locking=False) as file:
                try:
                    file.attrs["complete"] = end.complete
                    file.attrs["faults"] = end.faults
                    file.attrs["checksum"] = files.attribute_checksum(file.attrs)
                    file.flush()
                except BaseException:
                    _redirect_to_memory(file)
                    raise
            with self.partial.open("rb") as whole:
                os.fsync(whole.fileno())
            if end.complete and self._overwrite:
                self.partial.replace(self.path)
            else:
                os.link(self.partial, self.path)  # fails where a file exists by now
                self.partial.unlink()
        except FileExistsError:
            if end.complete:
                raise RecordingError(
                    f"{self.path} was made by another program meanwhile; the recording is in {self.partial}"
                ) from None
        except (OSError, RuntimeError) as error:
            raise RecordingError(
                f"{self.partial}: cannot be completed: {_cause(error)}; all that was recorded is in it"
            ) from error


def _cause(error: Exception) -> str:
    """Return the system's message, out of HDF5's long one."""
    found = re.search(r"error message = '([^']+)'", str(error))
    return found[1] if found else getattr(error, "strerror", None) or str(error)


def _redirect_to_memory(file: h5py.File | None) -> None:
    """Make HDF5 write the rest of ``file`` to memory, after an error; what is on disk stays unchanged.

    HDF5 writes its caches when it closes a file, and can crash the process where it cannot.
    """
    with contextlib.suppress(Exception):
        memory = os.memfd_create("batchpid-rest", os.MFD_CLOEXEC)
        os.dup2(memory, file.id.get_vfd_handle(), inheritable=False)  # type: ignore[union-attr]
        os.close(memory)


def _free_name(path: Path) -> Path:
    """Return the first of ``NAME.partial``, ``NAME.partial2``, ... that does not exist."""
    names = (path.with_name(f"{path.name}.partial{number}") for number in ("", *range(2, 10**6)))
    return next(name for name in names if not os.path.lexists(name))
