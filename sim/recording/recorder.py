"""Recorder: every tick of a runner, streamed to an HDF5 file that can be read at any time, even
after a kill.

The runner calls :meth:`Recorder.prepare` before a tick, and :meth:`Recorder.append` after it, with
Ctrl-C held back.
"""

from __future__ import annotations

import io
import os
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from batchpid.arrays.array_types import Rows
from batchpid.checks import flag, instance
from batchpid.errors import ClosedError, InvalidArgumentError, SingleOwner
from batchpid.sim.recording import recording_files as files
from batchpid.sim.recording.recording_files import RecordingError
from batchpid.sim.rollout import RunInfo
from batchpid.sim.signals import Observation
from batchpid.stages.values import Command

if TYPE_CHECKING:
    import h5py

    from batchpid.sim.runner.runner import Runner

WRITE_PERIOD = 0.5
"""Time from one write to the next [s]. A kill loses the ticks since the last one."""


class Recorder(SingleOwner):
    """Recorder of every tick of ``runner`` until it is closed.

    The file appears with the first tick. If a tick cannot be written, the next one raises
    RecordingError before it begins, and so does :meth:`close`.

    Parameters
    ----------
    path
        File to write, ending in .h5 or .hdf5.
    runner
        Runner to record. While it is recorded all its ticks have the same length.
    overwrite
        Whether an existing file of that name is replaced.

    Raises
    ------
    InvalidArgumentError
        The file exists, its name ends otherwise, or another Recorder records the runner.
    ClosedError
        The runner is closed.
    """

    instead = "close it, and record the next run with another Recorder"

    def __init__(
        self,
        path: str | os.PathLike[str],
        runner: Runner,
        *,
        overwrite: bool = False,
    ) -> None:
        # It loads the engine, as the runner has done already.
        from batchpid.sim.runner.runner import Runner

        if instance("runner", runner, Runner, "pass the runner to record").closed:
            raise ClosedError("this Runner is closed; record one that is not")
        if runner.recorder is not None:
            problem = f"is being recorded already, to {runner.recorder.path}"
            raise InvalidArgumentError("runner", problem, remedy="close that Recorder first")
        if flag("overwrite", overwrite):
            self._mode = "w+"
        else:
            self._mode = "x+"
        self.path: Path = files.check_path(path, overwrite=overwrite)
        self._runner = runner
        self._info: RunInfo | None = None  # at the first tick
        self._file: h5py.File | None = None
        self._rows: list[dict[str, Rows]] = []  # not written yet
        self._count = 0  # of written rows
        self._last_write = time.monotonic()
        self._rates = False  # whether a recorded tick had rates
        self._error: Exception | None = None
        runner.recorder = self

    def prepare(self) -> None:
        """Keep the state before the first tick.

        Raises
        ------
        RecordingError
            An earlier tick could not be written.
        """
        if self._error is not None:
            # HDF5 writes several lines.
            cause = " ".join(str(self._error).split())
            if isinstance(self._error, FileExistsError):
                cause = "it exists since the recorder was made; pass overwrite=True"
            raise RecordingError(f"{self.path}: cannot be written: {cause}") from self._error
        if self._info is None:
            self._info = replace(self._runner.info, complete=False)

    def append(
        self,
        time_: float,
        command: Command,
        observation: Observation,
        changes: Rows | None,
    ) -> None:
        """Record the state at ``time_`` [s] after a tick under ``command``, and the ``changes``
        (envs,) before it. The arrays may change afterwards.
        """
        self._rates |= command.setpoint_rate is not None
        rows: dict[str, Rows | None] = observation._asdict()
        rows["time"] = np.array(time_)
        rows["setpoint"] = np.array(command.setpoint)
        rows["changes"] = changes
        if command.feedforward is not None:
            rows["feedforward"] = np.array(command.feedforward)
        self._rows.append({name: row for name, row in rows.items() if row is not None})
        if time.monotonic() - self._last_write > WRITE_PERIOD:
            with suppress(RecordingError):  # the next tick raises it
                self._write()

    def close(self, complete: bool = True) -> None:
        """Write the remaining rows and close the file. May be called again, as after an interrupt.

        ``complete`` says whether the recording has all ticks of its run.

        Raises
        ------
        RecordingError
            The file cannot be written.
        """
        if self._runner.recorder is not self:
            return
        try:
            if complete:
                self.prepare()
        finally:
            if self._info is not None and self._error is None:
                self._write()
                if self._file:  # not closed yet
                    info = replace(
                        self._info,
                        complete=complete,
                        faults=self._runner.faults,
                        rates=self._rates,
                    )
                    self._file.attrs.update(files.attributes(info))
                    self._close_file()
            self._runner.recorder = None

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.close(complete=kind is None)

    def _close_file(self) -> None:
        if self._file:
            self._file.close()
            self._output.close()

    def _write(self) -> None:
        """Write the rows that are not written yet, into a new file at first. Raises
        RecordingError.
        """
        import h5py

        rows = self._rows
        runner = self._runner
        try:
            if self._file is None:
                assert self._info is not None
                tick = runner.timestep * runner.substeps
                self.path.parent.mkdir(parents=True, exist_ok=True)
                self._output = _Output(self.path, self._mode)
                self._file = h5py.File(self._output, "w", libver=files.LIBVER)
                self._datasets = files.create_datasets(
                    self._file, self._info, runner.num_envs, tick
                )
            if rows:
                files.write_rows(self._datasets, self._count, _stacked(rows))
            if self._output.error is not None:
                raise self._output.error
        except (OSError, RuntimeError) as error:
            self._error = error
            self._close_file()
            self.prepare()  # raises
        self._count += len(rows)
        self._rows = []
        self._last_write = time.monotonic()


class _Output(io.FileIO):
    """File that HDF5 writes. It keeps the first error, of which HDF5 learns nothing: after one it
    would crash the process at its end.
    """

    error: OSError | None = None

    def write(self, data: Any) -> int:
        try:
            if self.error is None:
                super().write(data)
        except OSError as error:
            self.error = error
        return len(data)


def _stacked(rows: list[dict[str, Rows]]) -> dict[str, Rows]:
    """Return the arrays of successive ticks, ticks first; 0 where a tick has none."""
    arrays = {}
    # Feedforwards may begin, and end, with any tick; changes are rare.
    for name in dict.fromkeys(name for row in rows for name in row):
        present = next(row[name] for row in rows if name in row)
        zeros = np.zeros_like(present)
        arrays[name] = np.array([row.get(name, zeros) for row in rows])
    return arrays
