"""Recordings: HDF5 files with the arrays of a :class:`batchpid.sim.Rollout` under their names,
ticks first.

Each field of its :class:`batchpid.sim.RunInfo` is an attribute of the file: a number, a text, an
array of them, or JSON (:data:`READERS`). Two more are ``num_envs`` and ``tick`` [s]. The datasets
``feedforward`` and ``changes`` are empty where there are none.

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
from batchpid.arrays.array_types import Document
from batchpid.checks import file_path, instance
from batchpid.errors import BatchPIDError, InvalidArgumentError, RobotError
from batchpid.io.files import write_atomically
from batchpid.sim.loop.faults import Fault
from batchpid.sim.rollout import OPTIONAL, Rollout, RunInfo
from batchpid.sim.signals import CommandSpec, Observation

if TYPE_CHECKING:
    import h5py  # functions load it, since commands that record nothing start sooner without it

FORMAT = "batchpid-recording-3"
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
    overwrite: bool = False,
) -> Path:
    """Write ``rollout`` to ``path`` as a whole or not at all, making its folder, and return the
    path.

    Parameters
    ----------
    path
        File to write, ending in .h5 or .hdf5.
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
    import h5py

    content = io.BytesIO()  # on a full disk HDF5 could not close its own file
    with h5py.File(content, "w", libver=LIBVER) as file:
        datasets = create_datasets(file, rollout.info, rollout.num_envs, rollout.tick)
        write_rows(datasets, 0, rollout.arrays())
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, content.getvalue(), overwrite)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be written: {error.strerror or error}") from error
    return path


def read_recording(path: str | os.PathLike[str]) -> Rollout:
    """Read a recording: complete, cut short by a kill, or one that is still being written.

    ``info.complete`` of the result says whether the run came to its end. Nothing in the file is
    executed; SECURITY.md lists the risks of files of unknown origin.

    Parameters
    ----------
    path
        An HDF5 file of any name.

    Raises
    ------
    RecordingError
        The file is missing, damaged, or no recording.
    """
    import h5py

    path = file_path("path", path)
    try:
        if not path.is_file():
            raise FileNotFoundError("there is no such file")
        with h5py.File(path, "r", locking=False) as file:
            if file.attrs.get("format") != FORMAT:
                raise ValueError(f"its format is not {FORMAT}")
            info = read_info(file.attrs)
            num_envs = int(file.attrs["num_envs"])
            _check_info(info, num_envs)
            tick = float(file.attrs["tick"])
            time = file["time"][:]
            # The rows of a run that still goes on, or was killed, end at the first without a time.
            count = int(np.append(np.isfinite(time), False).argmin())
            arrays = {"time": time[:count]}
            for name, quantity in info.recorded.items():
                array = file[name][:count]
                shape = (count, *info.row_shape(name, num_envs))
                if array.shape != shape:
                    raise ValueError(f"its {name} has shape {array.shape}, not {shape}")
                arrays[name] = array.astype(quantity.dtype, casting="same_kind", copy=False)
            for name in OPTIONAL:
                if not file[name].id.get_storage_size():
                    arrays[name] = None
    except Exception as error:  # a damaged file can make HDF5 raise anything
        raise RecordingError(
            f"{path}: cannot be read as a recording: {error or type(error).__name__}"
        ) from error
    inputs = {name: arrays.pop(name) for name in ("time", "setpoint", *OPTIONAL)}
    return Rollout(
        **inputs,
        observation=Observation(**arrays),
        tick=tick,
        info=info,
    )


def _check_info(info: RunInfo, num_envs: int) -> None:
    """Raise ValueError for an array of a file whose shape is not that of its field."""
    joints: tuple[int, ...] = (len(info.joint_names),)
    shapes = dict.fromkeys(("units", "lower", "upper", "effort_limit"), joints)
    shapes |= {"start": (num_envs, *joints), "episodes": (num_envs, 2)}
    for name, shape in shapes.items():
        value = getattr(info, name)
        if value is not None and np.shape(value) != shape:
            raise ValueError(f"its {name} has shape {np.shape(value)}, not {shape}")


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
    file: h5py.File,
    info: RunInfo,
    num_envs: int,
    tick: float,
) -> dict[str, h5py.Dataset]:
    """Write ``info`` to a new file; return empty datasets that can grow: time and
    :attr:`RunInfo.recorded`.
    """
    info = replace(info, urdf=_urdf_of(info))
    file.attrs.update(attributes(info) | {"format": FORMAT, "num_envs": num_envs, "tick": tick})
    time = file.create_dataset(
        "time",
        (0,),
        "f8",
        maxshape=(None,),
        chunks=(4096,),
        fillvalue=np.nan,
    )
    time.attrs["unit"] = ["s"]
    datasets = {"time": time}
    for name, quantity in info.recorded.items():
        row = info.row_shape(name, num_envs)
        dtype = np.dtype(quantity.dtype)
        rows = max(1, CHUNK_BYTES // max(1, int(np.prod(row)) * dtype.itemsize))
        datasets[name] = dataset = file.create_dataset(
            name, (0, *row), dtype, maxshape=(None, *row), chunks=(rows, *row)
        )
        dataset.attrs["unit"] = list(info.units_of(name))
    return datasets


def _urdf_of(info: RunInfo) -> str | None:
    """Return the robot of a run as a URDF; None for one that a URDF cannot hold."""
    if info.description is None:
        return info.urdf
    from batchpid.sim.robot.urdf_export import to_urdf

    with suppress(RobotError):
        return to_urdf(info.description).text
    return None


def write_rows(datasets: Mapping[str, h5py.Dataset], first: int, arrays: Document) -> None:
    """Write ``arrays``, ticks first, from row ``first`` on; it can be repeated if it was
    interrupted.
    """
    time = datasets["time"]
    end = first + len(arrays["time"])
    for name, dataset in datasets.items():
        if name != "time":
            dataset.resize(end, axis=0)
            if arrays.get(name) is not None:
                dataset[first:end] = arrays[name]
    # A row is valid once it has a time, so times follow when the rest is on the disk.
    time.file.flush()
    time.resize(end, axis=0)
    time[first:end] = arrays["time"]
    time.file.flush()


# -- attributes
# --------------------------------------------------------------------------------------------------


READERS: dict[str, Callable[[Any], Any]] = {
    "own_command": lambda entries: CommandSpec(*entries),
    "faults": lambda faults: tuple([Fault(*fault) for fault in faults]),
    "draws": lambda draws: {name: np.array(rows, np.float64) for name, rows in draws.items()},
    "versions": dict,
    "randomization": dict,
}
"""Fields of :class:`RunInfo` that are JSON in a recording, and how they are read from it."""


def attributes(info: RunInfo) -> Document:
    """Return the fields of ``info`` that are not None as texts, numbers, and arrays of them."""
    values: Document = {}
    for name, value in vars(info).items():
        if value is None or name == "description":
            continue
        if name == "params":
            value = bp.dumps_params(value, info.joint_names)
        elif name == "actuators":
            value = bp.motors.dumps_actuators(value, info.joint_names)
        elif name in READERS:
            if isinstance(value, CommandSpec):
                value = value.names, value.units
            value = json.dumps(value, default=np.ndarray.tolist)
        if isinstance(value, tuple):
            values[name] = list(value)
        else:
            values[name] = value
    return values


def read_info(values: Document) -> RunInfo:
    """Return the :class:`RunInfo` in the attributes of a recording."""
    joints = tuple(values["joint_names"])
    read: Document = {}
    for field in fields(RunInfo):
        if field.name not in values:
            continue
        value = values[field.name]
        if field.name == "params":
            value = bp.loads_params(value, joints)[0]
        elif field.name == "actuators":
            value = bp.motors.loads_actuators(value, joints)[0]
        elif field.name in READERS:
            value = READERS[field.name](json.loads(value))
        elif isinstance(value, np.generic):
            value = value.item()
        elif isinstance(value, np.ndarray) and (value.dtype.kind == "O" or not value.size):
            value = tuple(value)  # of texts
        read[field.name] = value
    return RunInfo(**read)
