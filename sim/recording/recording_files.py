"""Recordings: HDF5 files with the arrays of a :class:`batchpid.sim.Rollout` under their names,
ticks first.

Each field of its :class:`batchpid.sim.RunInfo` is an attribute of the file: a number, a text, an
array of them, or JSON (:data:`CODECS`). Two more are ``num_envs`` and ``tick`` [s]. The dataset
``feedforward`` is empty where none was given.

A row is valid if its ``time`` is a number: times are written last, and only after the other arrays
are on the disk. So any reader of HDF5 can read the file after a kill, up to the last row that has a
time.
"""

from __future__ import annotations

import io
import json
import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import batchpid as bp
from batchpid.arrays.array_types import Document, Rows
from batchpid.checks.validate import file_path, instance, integer
from batchpid.errors import BatchPIDError, InvalidArgumentError, RobotError
from batchpid.io.files import write_atomically
from batchpid.sim.loop.faults import Fault
from batchpid.sim.signals.quantities import CommandSpec, Observation, Quantity
from batchpid.sim.signals.rollout import Redraw, Rollout, RunInfo

if TYPE_CHECKING:
    import h5py  # functions load it, since commands that record nothing start sooner without it

FORMAT = "batchpid-recording-2"
HDF5 = (".h5", ".hdf5")
LIBVER = ("v108", "v108")
"""Versions of HDF5's format. Later ones mark a file that was not closed, and HDF5 then refuses to
open it.
"""
CHUNK_BYTES = 1 << 18
"""Approximate size of a chunk of a dataset."""


class RecordingError(BatchPIDError, OSError):
    """A recording cannot be written or read; the message names the file and the cause."""


def write_recording(
    rollout: Rollout,
    path: str | os.PathLike[str],
    *,
    seed: int | None = None,
    overwrite: bool = False,
) -> Path:
    """Write ``rollout`` to ``path`` as a whole or not at all, making its folder, and return the
    path.

    Parameters
    ----------
    path
        File to write, ending in .h5 or .hdf5.
    seed
        Seed of the run, kept in the recording; default: the seed in ``rollout.info``.
    overwrite
        Whether an existing file is replaced.

    Raises
    ------
    InvalidArgumentError
        The file exists already, or its name ends otherwise.
    RecordingError
        The file cannot be written.
    """
    instance("rollout", rollout, Rollout, "pass what runner.rollout() returned")
    path = check_path(path, overwrite=overwrite)
    if seed is None:
        info = rollout.info
    else:
        info = replace(rollout.info, seed=integer("seed", seed, 0, 2**63 - 1))
    import h5py

    content = io.BytesIO()  # on a full disk HDF5 could not close its own file
    with h5py.File(content, "w", libver=LIBVER) as file:
        write_rows(create_datasets(file, info, rollout.num_envs, rollout.tick), 0, rollout.arrays())
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, content.getvalue(), overwrite)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be written: {error.strerror or error}") from error
    return path


def read_recording(path: str | os.PathLike[str], *, every: int = 1) -> Rollout:
    """Read a recording: complete, cut short by a kill, or one that is still being written.

    ``info.complete`` of the result says whether the run came to its end. Nothing in the file is
    executed; SECURITY.md lists the risks of files of unknown origin.

    Parameters
    ----------
    path
        An HDF5 file of any name.
    every
        Keep every n-th tick.

    Raises
    ------
    RecordingError
        The file is missing, damaged, or no recording.
    """
    import h5py

    path = file_path("path", path)
    every = integer("every", every, 1, 10**9)
    try:
        if not path.is_file():
            raise FileNotFoundError("there is no such file")
        with h5py.File(path, "r", locking=False) as file:
            if file.attrs.get("format") != FORMAT:
                raise ValueError(f"its format is not {FORMAT}")
            info = read_info(file.attrs)
            num_envs = int(file.attrs["num_envs"])
            tick = float(file.attrs["tick"])
            time = file["time"][:]
            is_written = np.isfinite(time)
            if is_written.all():
                count = len(time)
            else:
                count = int(is_written.argmin())
            rows = slice(0, count, every)
            arrays = {"time": time[rows]}
            for name, quantity in info.recorded.items():
                shape = (len(arrays["time"]), *info.row_shape(name, num_envs))
                arrays[name] = _read_rows(file[name], rows, shape, quantity)
            if not file["feedforward"].id.get_storage_size():
                arrays["feedforward"] = None
    except Exception as error:  # a damaged file can make HDF5 raise anything
        raise RecordingError(
            f"{path}: cannot be read as a recording: {error or type(error).__name__}"
        ) from error
    inputs = {name: arrays.pop(name) for name in ("time", "setpoint", "feedforward")}
    return Rollout(**inputs, observation=Observation(**arrays), tick=tick * every, info=info)


def _read_rows(
    dataset: h5py.Dataset, rows: slice, shape: tuple[int, ...], quantity: Quantity
) -> Rows:
    array: Rows = dataset[rows]
    if array.shape != shape:
        raise ValueError(f"its {dataset.name} has shape {array.shape}, not {shape}")
    return array.astype(quantity.dtype, casting="same_kind", copy=False)


def check_path(path: str | os.PathLike[str], *, overwrite: bool) -> Path:
    """Return ``path`` if a recording can be written there.

    Raises
    ------
    InvalidArgumentError
        Its suffix is not in :data:`HDF5`, or the file exists and ``overwrite`` is False.
    """
    path = file_path("path", path, HDF5)
    if os.path.lexists(path) and not overwrite:
        remedy = "choose another name, or pass overwrite=True"
        raise InvalidArgumentError("path", "exists already", value=str(path), remedy=remedy)
    return path


def create_datasets(
    file: h5py.File, info: RunInfo, num_envs: int, tick: float
) -> dict[str, h5py.Dataset]:
    """Write ``info`` to a new file; return empty datasets that can grow: time and
    :attr:`RunInfo.recorded`.
    """
    info = replace(info, urdf=_urdf_of(info))
    file.attrs.update(attributes(info) | {"format": FORMAT, "num_envs": num_envs, "tick": tick})
    datasets = {
        "time": file.create_dataset(
            "time", (0,), "f8", maxshape=(None,), chunks=(4096,), fillvalue=np.nan
        )
    }
    datasets["time"].attrs["unit"] = ["s"]
    for name, quantity in info.recorded.items():
        row = info.row_shape(name, num_envs)
        dtype = np.dtype(quantity.dtype)
        rows = max(1, CHUNK_BYTES // max(1, int(np.prod(row)) * dtype.itemsize))
        datasets[name] = file.create_dataset(
            name, (0, *row), dtype, maxshape=(None, *row), chunks=(rows, *row)
        )
        if info.units_of(name):
            datasets[name].attrs["unit"] = list(info.units_of(name))
    return datasets


def _urdf_of(info: RunInfo) -> str | None:
    """Return the robot of a run as a URDF; None for one whose file is gone or has changed."""
    robot = info.description
    if robot is None:
        return info.urdf
    if robot.path.is_file():  # reading a pipe again could block
        from batchpid.sim.robot.urdf_export import to_urdf

        with suppress(RobotError):
            return to_urdf(robot).text
    return None


def write_rows(datasets: Mapping[str, h5py.Dataset], first: int, arrays: Mapping[str, Any]) -> None:
    """Write ``arrays``, ticks first, from row ``first`` on; it can be repeated if it was
    interrupted.
    """
    time = datasets["time"]
    end = first + len(arrays["time"])
    for name, dataset in datasets.items():
        rows = arrays.get(name)
        if dataset is not time:
            dataset.resize(end, axis=0)
            if rows is not None:
                dataset[first:end] = rows
    # a row is valid once it has a time, so times follow when the rest is on the disk
    time.file.flush()
    time.resize(end, axis=0)
    time[first:end] = arrays["time"]
    time.file.flush()


# -- attributes
# --------------------------------------------------------------------------------------------------


Codec = tuple[Callable[[Any, tuple[str, ...]], object], Callable[[Any, tuple[str, ...]], Any]]


def _json(write: Callable[[Any], object], read: Callable[[Any], Any]) -> Codec:
    """Return functions that write a value as JSON of what ``write`` makes of it, and read it."""
    return (
        lambda value, joints: json.dumps(write(value)),
        lambda text, joints: read(json.loads(text)),
    )


CODECS: dict[str, Codec] = {
    "params": (
        lambda params, joints: bp.dumps_params(params, joints, format="json"),
        lambda text, joints: bp.loads_params(text, joints)[0],
    ),
    "actuators": (
        lambda actuators, joints: bp.motors.dumps_actuators(actuators, joints, format="json"),
        lambda text, joints: bp.motors.loads_actuators(text, joints)[0],
    ),
    "own_command": _json(
        lambda command: [command.names, command.units], lambda entries: CommandSpec(*entries)
    ),
    "faults": _json(list, lambda faults: tuple([Fault(*fault) for fault in faults])),
    "redraws": _json(list, lambda redraws: tuple([Redraw(*redraw) for redraw in redraws])),
    "draws": _json(
        lambda draws: {name: rows.tolist() for name, rows in draws.items()},
        lambda draws: {name: np.array(rows, np.float64) for name, rows in draws.items()},
    ),
    "versions": _json(dict, dict),
    "randomization": _json(dict, dict),
    "options": _json(dict, dict),
}
"""Fields of :class:`RunInfo` that are JSON in a recording: functions (value, joint names) that
write and read them.
"""


def attributes(info: RunInfo) -> Document:
    """Return the fields of ``info`` that are not None as texts, numbers, and arrays of them."""
    values: Document = {name: value for name, value in vars(info).items() if value is not None}
    values.pop("description", None)
    for name, value in values.items():
        if name in CODECS:
            values[name] = CODECS[name][0](value, info.joint_names)
        elif isinstance(value, tuple):
            values[name] = list(value)
    return values


def read_info(values: Mapping[str, Any]) -> RunInfo:
    """Return the :class:`RunInfo` in the attributes of a recording."""
    joints = tuple(values["joint_names"])
    read: Document = {}
    for name in {field.name for field in fields(RunInfo)} & set(values):
        value = values[name]
        if name in CODECS:
            read[name] = CODECS[name][1](value, joints)
        elif isinstance(value, np.ndarray):
            is_text = value.dtype.kind == "O" or not value.size
            read[name] = tuple(value) if is_text else value
        else:
            if isinstance(value, np.generic):
                read[name] = value.item()
            else:
                read[name] = value
    return RunInfo(**read)
