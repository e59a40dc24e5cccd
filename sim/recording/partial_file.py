"""HDF5 file that grows under a temporary name, and can be read at any time, even after a kill or on a full disk."""

from __future__ import annotations

import contextlib
import errno
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from batchpid.arrays.array_types import Rows
from batchpid.checks.single_owner import SingleOwner
from batchpid.sim.observation import RunInfo
from batchpid.sim.recording import recording_files as files
from batchpid.sim.recording.recording_files import RecordingError

if TYPE_CHECKING:
    import h5py

METADATA_BYTES = 1 << 18
"""Disk space that is kept for what HDF5 notes about the next rows."""


class PartialFile(SingleOwner):
    """File ``partial``, which gets the name ``path`` when it is complete.

    Parameters
    ----------
    path, partial
        Its name at the end, and until then.
    info
        Robot, options and origin of the run.
    num_envs
        Number of envs, in each row.
    tick
        Time between rows [s].
    overwrite
        Whether it replaces an existing file at the end.

    Raises
    ------
    RecordingError
        The file cannot be made.
    """

    def __init__(
        self, path: Path, partial: Path, info: RunInfo, num_envs: int, tick: float, *, overwrite: bool
    ) -> None:
        self._path, self._partial, self._overwrite = path, partial, overwrite
        self._chunk = max(files.CHUNK_BYTES, 8 * num_envs * max(len(info.joint_names), info.command.size))
        h5py = files.load_h5py()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = h5py.File(partial, "x", libver="latest", rdcc_nbytes=files.CHUNK_BYTES, rdcc_w0=1.0)
            try:
                self._reserve(0)
                self._datasets = files.create_datasets(self._file, info, num_envs, tick)
                self._file.flush()
                self._file.swmr_mode = True
            except BaseException:
                self._abandon()
                partial.unlink()
                raise
        except (OSError, RuntimeError) as error:
            if not isinstance(error, FileExistsError):  # on a full disk HDF5 leaves an empty file
                partial.unlink(missing_ok=True)
            raise RecordingError(f"{partial}: cannot be made: {_cause(error)}") from error

    def append(self, arrays: Mapping[str, Rows]) -> None:
        """Append rows, ticks first. Raises RecordingError if they cannot be written; the file is closed."""
        try:
            self._reserve(self._file.id.get_filesize(), sum(array.nbytes for array in arrays.values()))
            files.append_rows(self._datasets, arrays)
        except Exception as error:
            self._abandon()
            raise RecordingError(
                f"{self._partial}: cannot be written: {_cause(error)}; what was recorded before can be read"
            ) from error

    def discard(self) -> None:
        """Close and remove the file."""
        self._file.close()
        self._partial.unlink()

    def finish(self, complete: bool, faults: str, redraws: str, rates: bool) -> None:
        """Close the file and give it its name; one that is not ``complete`` keeps the partial name if that one exists.

        Raises RecordingError if it cannot be completed, or another program has made a file of its name.
        """
        size = self._file.id.get_filesize()
        with contextlib.suppress(Exception):
            self._file.close()
        try:
            self._reserve(size, len(faults) + len(redraws))
            # Without a lock, because a reader may hold one.
            with files.load_h5py().File(self._partial, "r+", locking=False) as file:
                try:
                    file.attrs["complete"] = complete
                    file.attrs["faults"] = faults
                    file.attrs["redraws"] = redraws
                    file.attrs["rates"] = rates
                    file.attrs["checksum"] = files.attribute_checksum(file.attrs)
                    file.flush()
                except BaseException:
                    _redirect_to_memory(file)
                    raise
            with self._partial.open("rb") as whole:
                os.fsync(whole.fileno())
            if complete and self._overwrite:
                self._partial.replace(self._path)
            else:
                os.link(self._partial, self._path)  # fails where a file exists by now
                self._partial.unlink()
        except FileExistsError:
            if complete:
                raise RecordingError(
                    f"{self._path} was made by another program meanwhile; the recording is in {self._partial}"
                ) from None
        except (OSError, RuntimeError) as error:
            raise RecordingError(
                f"{self._partial}: cannot be completed: {_cause(error)}; all that was recorded is in it"
            ) from error

    def _abandon(self) -> None:
        """Close the file without changing it on disk."""
        _redirect_to_memory(self._file)
        with contextlib.suppress(Exception):
            self._file.close()

    def _reserve(self, end: int, size: int = 0) -> None:
        """Allocate disk space after ``end`` for ``size`` bytes of rows: HDF5 can crash after a write that failed."""
        size += 2 * len(files.DTYPES) * self._chunk + METADATA_BYTES  # a chunk of each dataset is not full
        with self._partial.open("r+b") as disk:
            try:
                os.posix_fallocate(disk.fileno(), end, size)
            except OSError as error:
                if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO):
                    raise  # with another error the file system does not offer it


def _cause(error: Exception) -> str:
    """Return the system's message, out of HDF5's long one."""
    found = re.search(r"error message = '([^']+)'", str(error))
    return found[1] if found else getattr(error, "strerror", None) or str(error)


def _redirect_to_memory(file: h5py.File) -> None:
    """Make HDF5 write the rest of ``file`` to memory, after an error; the file on disk stays unchanged.

    HDF5 writes its caches when it closes a file, and can crash the process where it cannot.
    """
    with contextlib.suppress(Exception):
        memory = os.memfd_create("batchpid-rest", os.MFD_CLOEXEC)
        os.dup2(memory, file.id.get_vfd_handle(), inheritable=False)
        os.close(memory)
