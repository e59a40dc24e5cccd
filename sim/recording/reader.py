"""Read recordings: see :mod:`sim.recording.recorder` for what they hold."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid.errors import InvalidArgumentError
from batchpid.validate import integer
from sim.recording.recorder import FIELDS, FORMAT, PER_JOINT, RecordingError, load_h5py


@dataclass(frozen=True)
class Recording:
    """A recording, read: arrays as in :class:`sim.Rollout`, and what they belong to. See :func:`read_recording`."""

    path: Path
    time: NDArray[np.float64]
    setpoint: NDArray[np.float64]
    qpos: NDArray[np.float32]
    qvel: NDArray[np.float32]
    effort: NDArray[np.float32]
    saturated: NDArray[np.bool_]
    ok: NDArray[np.bool_]
    attributes: dict[str, Any]

    @property
    def complete(self) -> bool:
        """Whether the run came to its end."""
        return bool(self.attributes["complete"])

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints."""
        return tuple(map(str, self.attributes["joint_names"]))

    @property
    def params(self) -> bp.PIDParams:
        """The params at the start of the recording."""
        return bp.loads_params(str(self.attributes["params"]), self.joint_names)[0]


def read_recording(path: str | os.PathLike[str], *, every: int = 1) -> Recording:
    """Read a recording: complete, cut short by a kill, or one that is still being written.

    Parameters
    ----------
    every
        Take every so-manieth tick.

    Raises
    ------
    RecordingError
        The file is missing, or no recording.
    """
    if not isinstance(path, str | os.PathLike):
        raise InvalidArgumentError("path", "must be a path", value=path, remedy="pass the file's name")
    every = integer("every", every, 1, 10**9)
    h5py, path = load_h5py(), Path(path)
    try:
        found = path.is_file()
    except (OSError, ValueError) as error:  # no name that a file can have
        raise RecordingError(f"{path}: cannot be read: {error}") from error
    if not found:
        raise RecordingError(f"{path}: there is no such file; after a kill look for {path.name}.partial")
    try:
        try:
            file = h5py.File(path, "r")
        except OSError:
            file = h5py.File(path, "r", swmr=True, libver="latest")  # someone writes it, or was killed while doing so
        with file:
            attributes = dict(file.attrs)
            if attributes.get("format") != FORMAT:
                raise ValueError(f"its format is {attributes.get('format')!r}, not {FORMAT!r}")
            lacking = {"complete", "faults", "params", *PER_JOINT} - set(attributes)
            if lacking:
                raise ValueError(f"it does not say its {', '.join(sorted(lacking))}")
            times = file["time"][:]
            count = int(np.isfinite(times).sum())
            arrays = {name: file[name][:count:every] for name in FIELDS}
            _check_shapes(arrays, attributes)
    except (OSError, ValueError, KeyError, RuntimeError, TypeError, AttributeError) as error:
        raise RecordingError(f"{path}: cannot be read as a recording: {error}") from error
    return Recording(path=path, time=times[:count:every], attributes=attributes, **arrays)


def _check_shapes(arrays: dict[str, NDArray[Any]], attributes: dict[str, Any]) -> None:
    ticks, envs = arrays["ok"].shape
    dof = len(attributes["joint_names"])
    for name, rows in arrays.items():
        shape = (ticks, envs) if name == "ok" else (ticks, envs, dof)
        if rows.shape != shape or rows.dtype != FIELDS[name]:
            raise ValueError(f"its {name} is {rows.dtype} {rows.shape}, not {np.dtype(FIELDS[name])} {shape}")
    for name in PER_JOINT:
        if np.shape(attributes[name]) != (dof,):
            raise ValueError(f"its {name} are {np.shape(attributes[name])}, not one for each of {dof} joints")
