"""Recordings: HDF5 files with the arrays of a :class:`batchpid.sim.Rollout` under their names,
ticks first.

Each field of its :class:`batchpid.sim.RunInfo` is an attribute of the file: a number, a text, an
array of them, or JSON (:data:`READERS`). Another one is ``tick`` [s].
"""

from __future__ import annotations

import io
import json
import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

import batchpid as bp
from batchpid.arrays.array_types import Document
from batchpid.checks import file_path, instance
from batchpid.errors import BatchPIDError, InvalidArgumentError, RobotError
from batchpid.io.files import write_atomically
from batchpid.sim.loop.faults import Fault
from batchpid.sim.rollout import OPTIONAL, Rollout, RunInfo
from batchpid.sim.signals import CommandSpec, Observation

FORMAT = "batchpid-recording-4"
HDF5 = (".h5", ".hdf5")


class RecordingError(BatchPIDError, OSError):
    """A recording cannot be read; the message names the file and the cause."""


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
    OSError
        The file cannot be written.
    """
    instance("rollout", rollout, Rollout, "pass what runner.rollout() returned")
    path = file_path("path", path, HDF5)
    if os.path.lexists(path) and not overwrite:
        remedy = "choose another name, or pass overwrite=True"
        raise InvalidArgumentError("path", "exists already", value=str(path), remedy=remedy)
    # Commands that record nothing start sooner without it.
    import h5py

    info = replace(rollout.info, urdf=_urdf_of(rollout.info))
    # On a full disk HDF5 could not close its own file. Older versions of its format hold no long
    # attributes.
    content = io.BytesIO()
    with h5py.File(content, "w", libver="v108") as file:
        file.attrs.update(attributes(info) | {"format": FORMAT, "tick": rollout.tick})
        for name, array in rollout.arrays().items():
            file[name] = array
            file[name].attrs["unit"] = ["s"] if name == "time" else list(info.units_of(name))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, content.getvalue(), overwrite)
    return path


def read_recording(path: str | os.PathLike[str]) -> Rollout:
    """Read a recording.

    Nothing in the file is executed; SECURITY.md lists the risks of files of unknown origin.

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
            tick = float(file.attrs["tick"])
            arrays = {"time": file["time"][:]}
            count = len(arrays["time"])
            num_envs = file["qpos"].shape[1]
            _check_info(info, num_envs)
            for name, quantity in info.recorded.items():
                if name in OPTIONAL and name not in file:
                    arrays[name] = None
                    continue
                array = file[name][:]
                shape = (count, *info.row_shape(name, num_envs))
                if array.shape != shape:
                    raise ValueError(f"its {name} has shape {array.shape}, not {shape}")
                arrays[name] = array.astype(quantity.dtype, casting="same_kind", copy=False)
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


def _urdf_of(info: RunInfo) -> str | None:
    """Return the robot of a run as a URDF; None for one that a URDF cannot hold."""
    if info.description is None:
        return info.urdf
    from batchpid.sim.robot.urdf_export import to_urdf

    with suppress(RobotError):
        return to_urdf(info.description).text
    return None


# -- attributes
# --------------------------------------------------------------------------------------------------


READERS: dict[str, Callable[[Any], Any]] = {
    "own_command": lambda entries: CommandSpec(*entries),
    "faults": lambda faults: tuple([Fault(*fault) for fault in faults]),
    "draws": lambda draws: {name: np.array(rows, np.float64) for name, rows in draws.items()},
    "versions": dict,
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
