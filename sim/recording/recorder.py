"""Recordings: every tick of a runner streamed to an HDF5 file, readable whatever ends the program.

A thread writes what was recorded every half second, and sees to it that the file on disk is whole at any moment (HDF5's
single-writer mode, times last). A tick waits while one recorded longer ago than ``_LAG`` is not on disk yet, so that at
most a second's ticks are missing after a kill, however slow the disk. The file grows beside its final name, as
``NAME.partial``, and takes that name when it is complete; no file of that name is touched before.

Datasets, ticks first: ``time`` [s], ``setpoint``, ``qpos``, ``qvel``, ``effort``, ``saturated`` (ticks, envs, dof) and
``ok`` (ticks, envs); row k is the state at the end of tick k. What they belong to stands in the attributes.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import threading
import time
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid.errors import BatchPIDError, ClosedError, InvalidArgumentError, MissingDependencyError
from batchpid.versions import package_versions

if TYPE_CHECKING:
    import h5py

    from sim.observation import Observation
    from sim.runner import Runner

FORMAT = "batchpid-recording-1"
_EVERY = 0.5  # seconds from one write to the next
_LAG = 0.75  # seconds by which what is on disk may lag behind what is recorded
_BUFFER = 64 << 20  # bytes that may wait to be written
_CHUNK = 1 << 18  # bytes of a chunk of the file, about

FIELDS = {
    "setpoint": np.float64,
    "qpos": np.float32,
    "qvel": np.float32,
    "effort": np.float32,
    "saturated": np.bool_,
    "ok": np.bool_,
}
PER_JOINT = ("joint_names", "units", "lower", "upper")  # attributes


class RecordingError(BatchPIDError, OSError):
    """A recording cannot be written or read; the message names the file and the cause."""


class Recorder:
    """Records every tick of ``runner`` from now on, until it is closed.

    Parameters
    ----------
    path
        File to write, ending in .h5 or .hdf5.
    runner
        What to record.
    seed
        Of the run, if it has one; kept with the recording.
    overwrite
        Whether an existing file of that name is replaced, at the end, by a complete recording.

    Raises
    ------
    InvalidArgumentError
        There is such a file, or the name ends otherwise; or another Recorder records the runner.
    ClosedError
        The runner is closed.
    MissingDependencyError
        h5py is not installed.
    RecordingError
        The file cannot be made.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        runner: Runner,
        *,
        seed: int | None = None,
        overwrite: bool = False,
    ) -> None:
        if not hasattr(runner, "recorder"):
            raise InvalidArgumentError(
                "runner", "must be a Runner", value=type(runner).__name__, remedy="pass the runner to record"
            )
        if runner.closed:
            raise ClosedError("this Runner is closed; record one that is not")
        if runner.recorder is not None:
            raise InvalidArgumentError(
                "runner",
                f"is being recorded already, to {runner.recorder.path}",
                remedy="close that Recorder first",
            )
        self.path: Path = check_path(path, overwrite=overwrite)
        self._overwrite, self._runner = overwrite, runner
        self.partial = _free_name(self.path)
        self._wake = threading.Condition()
        self._rows: list[tuple[Any, ...]] = []
        self._bytes = 0
        self._since = math.inf  # when the oldest row was recorded that is not on disk
        self._closing = False
        self._error: Exception | None = None
        self._file, self._datasets = self._create(seed)
        self._writer = threading.Thread(target=self._write_rows, name="batchpid-recorder", daemon=True)
        self._writer.start()
        runner.recorder = self

    def append(self, time_: float, setpoint: NDArray[Any], observation: Observation) -> None:
        """Record the state at ``time_`` [s], reached under ``setpoint`` (envs, dof). The runner calls it."""
        row = (time_, np.array(setpoint), *observation)
        with self._wake:
            while self._error is None and (self._bytes > _BUFFER or time.monotonic() - self._since > _LAG):
                self._wake.wait()
            self._check()
            self._rows.append(row)
            self._since = min(self._since, time.monotonic())
            self._bytes += sum(part.nbytes for part in row[1:])
            if len(self._rows) == 1:
                self._wake.notify_all()

    def close(self, complete: bool = True) -> None:
        """Write the rest, and give the file its name. May be called again.

        Where the run is not ``complete`` a file of that name stays, and the recording keeps its partial name.
        """
        if self._runner.recorder is self:
            self._runner.recorder = None
        if not self._writer.is_alive() and self._file is None:
            return
        with self._wake:
            self._closing = True
            self._wake.notify_all()
        self._writer.join()
        with contextlib.suppress(Exception):  # the writer's error, if any, is the one to raise
            if self._file is not None:
                self._file.close()
        self._file = None
        self._check()
        self._finish(complete)

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close(complete=kind is None)

    def _check(self) -> None:
        if self._error is not None:
            raise RecordingError(
                f"{self.partial}: cannot be written: {_cause(self._error)}; what was recorded before can be read"
            ) from self._error

    def _create(self, seed: int | None) -> tuple[h5py.File, dict[str, h5py.Dataset]]:
        h5py, runner = load_h5py(), self._runner
        shape = (runner.num_envs, runner.robot.dof)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            file = h5py.File(self.partial, "x", libver="latest", rdcc_nbytes=_CHUNK, rdcc_w0=1.0)
        except OSError as error:
            raise RecordingError(f"{self.partial}: cannot be made: {_cause(error)}") from error
        try:
            for name, value in _attributes(runner, seed).items():
                file.attrs[name] = value
            datasets = {
                "time": file.create_dataset("time", (0,), "f8", maxshape=(None,), chunks=(1024,), fillvalue=np.nan)
            }
            for name, dtype in FIELDS.items():
                table = shape[:1] if name == "ok" else shape
                rows = max(1, _CHUNK // (int(np.prod(table)) * np.dtype(dtype).itemsize))
                datasets[name] = file.create_dataset(
                    name, (0, *table), dtype, maxshape=(None, *table), chunks=(rows, *table)
                )
            for name, unit in _units(runner).items():
                datasets[name].attrs["unit"] = unit
            file.flush()
            file.swmr_mode = True
        except (OSError, RuntimeError) as error:
            _redirect_to_memory(file)
            file.close()
            self.partial.unlink()
            raise RecordingError(f"{self.partial}: cannot be made: {_cause(error)}") from error
        return file, datasets

    def _write_rows(self) -> None:
        """In a thread: write what has come in, every half second."""
        while True:
            with self._wake:
                while not self._rows and not self._closing:
                    self._wake.wait()
                closing = self._closing
                if not closing:
                    self._wake.wait_for(lambda: self._closing or self._bytes > _BUFFER, _EVERY)
                    closing = self._closing
                rows, self._rows, self._bytes = self._rows, [], 0
                taken = time.monotonic()
            try:
                if rows:
                    self._write(rows)
            except Exception as error:
                _redirect_to_memory(self._file)
                with self._wake:
                    self._error = error
                    self._wake.notify_all()
                return
            with self._wake:
                self._since = taken if self._rows else math.inf
                self._wake.notify_all()
            if closing:
                return

    def _write(self, rows: list[tuple[Any, ...]]) -> None:
        done = len(self._datasets["time"])
        names = ("time", "setpoint", "qpos", "qvel", "effort", "saturated", "ok")
        columns = dict(zip(names, map(np.array, zip(*rows, strict=True)), strict=True))
        times = columns.pop("time")
        for name, column in columns.items():
            dataset = self._datasets[name]
            dataset.resize(done + len(times), axis=0)
            dataset[done:] = column
            dataset.flush()
        # A reader, or whoever comes after a kill, counts the times: they are there when all else is.
        dataset = self._datasets["time"]
        dataset.resize(done + len(times), axis=0)
        dataset[done:] = times
        dataset.flush()

    def _finish(self, complete: bool) -> None:
        faults = [fault._asdict() for fault in self._runner.faults]
        try:
            # Without a lock: someone may be watching, and nobody else writes.
            with load_h5py().File(self.partial, "r+", locking=False) as file:
                try:
                    file.attrs["complete"] = complete
                    file.attrs["faults"] = json.dumps(faults)
                    file.flush()
                except BaseException:
                    _redirect_to_memory(file)
                    raise
            with self.partial.open("rb") as whole:
                os.fsync(whole.fileno())
            if complete and self._overwrite:
                self.partial.replace(self.path)
            else:
                os.link(self.partial, self.path)  # fails where there is a file by now
                self.partial.unlink()
        except FileExistsError:
            if complete:
                raise RecordingError(
                    f"{self.path} was made by someone else meanwhile; the recording is in {self.partial}"
                ) from None
        except (OSError, RuntimeError) as error:
            raise RecordingError(
                f"{self.partial}: cannot be completed: {_cause(error)}; all that was recorded is in it"
            ) from error


def check_path(path: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
    """Check, before anything runs, that a recording can be called ``path``.

    Raises
    ------
    InvalidArgumentError
        It is the name of a file, or ends otherwise than in .h5 or .hdf5.
    """
    if not isinstance(path, str | os.PathLike):
        raise InvalidArgumentError("path", "must be a path", value=path, remedy="pass a file name ending in .h5")
    path = Path(path)
    if path.suffix not in (".h5", ".hdf5"):
        raise InvalidArgumentError("path", "unknown file format", value=str(path), remedy="end it in .h5 or .hdf5")
    if path.exists() and not overwrite:
        raise InvalidArgumentError(
            "path", "exists already", value=str(path), remedy="choose another name, or pass overwrite=True"
        )
    return path


def _cause(error: Exception) -> str:
    """What the system said; HDF5 puts a lot around it."""
    said = re.search(r"error message = '([^']+)'", str(error))
    return said[1] if said else str(error)


def _redirect_to_memory(file: h5py.File) -> None:
    """Leave what is on disk of ``file`` as it is, when no more can be written to it.

    HDF5 writes the rest when it closes a file, and can crash the process where it cannot: it gets memory to write to.
    """
    with contextlib.suppress(Exception):
        memory = os.memfd_create("batchpid-rest", os.MFD_CLOEXEC)
        os.dup2(memory, file.id.get_vfd_handle(), inheritable=False)
        os.close(memory)


def _free_name(path: Path) -> Path:
    """A name beside ``path`` that no file has: what an earlier run left behind is kept."""
    partial, number = path.with_name(path.name + ".partial"), 1
    while partial.exists():
        number += 1
        partial = path.with_name(f"{path.name}.partial{number}")
    return partial


def load_h5py() -> Any:
    """The package, or an error that says how to get it."""
    try:
        import h5py
    except ImportError:
        raise MissingDependencyError("h5py", "recording to HDF5", "record") from None
    return h5py


def _units(runner: Runner) -> dict[str, list[str]]:
    joints = runner.robot.joints
    position, effort = [joint.unit for joint in joints], [joint.effort_unit for joint in joints]
    return {
        "time": ["s"],
        "setpoint": effort if runner.control == "effort" else position,
        "qpos": position,
        "qvel": [f"{unit}/s" for unit in position],
        "effort": effort,
    }


def _attributes(runner: Runner, seed: int | None) -> dict[str, Any]:
    robot = runner.robot
    return {
        "format": FORMAT,
        "complete": False,
        "faults": "[]",
        "robot": robot.name,
        "urdf": robot.urdf,
        "joint_names": list(robot.joint_names),
        "units": [joint.unit for joint in robot.joints],
        "lower": robot.lower,
        "upper": robot.upper,
        "effort_limit": robot.effort_limit,
        "num_envs": runner.num_envs,
        "timestep": runner.timestep,
        "substeps": runner.substeps,
        "control": runner.control,
        "compensate": runner.compensate,
        "dissipation": robot.dissipation,
        "params": bp.dumps_params(runner.params, robot.joint_names, format="json"),
        "seed": "none" if seed is None else seed,
        "versions": json.dumps(package_versions(("batchpid", "sapien", "numpy", "h5py"))),
        "begun": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
    }
