"""Recorder: every tick of a runner streamed to an .h5 file that can be read at any time, even after a kill.

A thread appends the recorded ticks every half second in HDF5's single-writer mode. A tick waits while the oldest row
that is not on disk was recorded more than :data:`MAX_LAG` ago, so that a kill loses at most a second's ticks, however
slow the disk. The file grows as ``NAME.partial`` and gets its name when it is complete; an existing file of that name
is not touched before. See :mod:`sim.recording.files` for what it holds.
"""

from __future__ import annotations

import contextlib
import errno
import math
import os
import re
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from batchpid.errors import ClosedError, InvalidArgumentError
from batchpid.validate import flag, instance, integer
from sim.observation import RECORDED, Observation
from sim.recording import files
from sim.recording.files import RecordingError

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
        self._wake = threading.Condition()
        self._rows: list[tuple[Any, ...]] = []  # time, setpoint, observation: not handed to the disk yet
        self._bytes = 0
        self._oldest = math.inf  # when the oldest row that is not on disk was recorded
        self._closing = False
        self._error: Exception | None = None
        self._file, self._datasets = self._create(None if seed is None else integer("seed", seed, 0, 2**63 - 1))
        self._writer = threading.Thread(target=self._write_rows, name="batchpid-recorder", daemon=True)
        self._writer.start()
        runner.recorder = self

    def append(self, time_: float, setpoint: NDArray[Any], observation: Observation) -> None:
        """Record the state at ``time_`` [s], reached under ``setpoint`` (envs, dof). The runner calls it."""
        row = (time_, np.array(setpoint), *observation)
        with self._wake:
            while self._error is None and (self._bytes > MAX_BUFFER or time.monotonic() - self._oldest > MAX_LAG):
                self._wake.wait()
            self._check()
            self._rows.append(row)
            self._oldest = min(self._oldest, time.monotonic())
            self._bytes += sum(part.nbytes for part in row[1:])
            if len(self._rows) == 1:
                self._wake.notify_all()

    def close(self, complete: bool = True) -> None:
        """Write the remaining rows and give the file its name. May be called again.

        A recording that is not ``complete`` keeps its partial name where a file of that name exists.
        """
        if self._runner.recorder is self:
            self._runner.recorder = None
        with self._wake:
            self._closing = True
            self._wake.notify_all()
        self._writer.join()
        if self._file is None:
            return
        file, self._file = self._file, None
        end = file.id.get_filesize()
        with contextlib.suppress(Exception):  # the writer's error, if any, is the one to raise
            file.close()
        self._check()
        self._finish(complete, end)

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.close(complete=kind is None)

    def _check(self) -> None:
        if self._error is not None:
            raise RecordingError(
                f"{self.partial}: cannot be written: {_cause(self._error)}; what was recorded before can be read"
            ) from self._error

    def _create(self, seed: int | None) -> tuple[h5py.File | None, dict[str, h5py.Dataset]]:
        h5py, runner = files.load_h5py(), self._runner
        info = replace(runner.info, seed=seed, complete=False)
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
        """Write the recorded rows every half second, in a thread, until the recorder is closed."""
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._rows or self._closing)
                self._wake.wait_for(lambda: self._closing or self._bytes > MAX_BUFFER, WRITE_PERIOD)
                closing = self._closing
                rows, self._rows, self._bytes = self._rows, [], 0
                taken = time.monotonic()
            try:
                if rows:
                    columns = map(np.array, zip(*rows, strict=True))
                    arrays = dict(zip(("time", *RECORDED), columns, strict=True))
                    self._reserve(
                        self._datasets["time"].file.id.get_filesize(), sum(array.nbytes for array in arrays.values())
                    )
                    files.append_rows(self._datasets, arrays)
            except Exception as error:
                _redirect_to_memory(self._file)
                self._error = error
            with self._wake:
                self._oldest = taken if self._rows else math.inf
                self._wake.notify_all()
            if closing or self._error is not None:
                return

    def _finish(self, complete: bool, end: int) -> None:
        try:
            faults = files.faults_text(self._runner.faults)
            self._reserve(end, len(faults))
            # Without a lock, because a reader may hold one.
            with files.load_h5py().File(self.partial, "r+", locking=False) as file:
                try:
                    file.attrs["complete"] = complete
                    file.attrs["faults"] = faults
                    file.attrs["checksum"] = files.attribute_checksum(file.attrs)
                    file.flush()
                except BaseException:
                    _redirect_to_memory(file)
                    raise
            with self.partial.open("rb") as whole:
                os.fsync(whole.fileno())
            if complete and self._overwrite:
                self.partial.replace(self.path)
            else:
                os.link(self.partial, self.path)  # fails where a file exists by now
                self.partial.unlink()
        except FileExistsError:
            if complete:
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
