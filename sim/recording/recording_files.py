"""Rollouts in files: written as a whole, or tick by tick by :class:`batchpid.sim.Recorder`, and read back.

A file is .npz (NumPy) or .h5 (HDF5). Both hold the arrays of a :class:`batchpid.sim.Rollout` under their names, ticks
first, and the known fields of its :class:`batchpid.sim.RunInfo`: as further arrays in an .npz file, as attributes of an
.h5 file. ``params``, ``versions`` and ``faults`` are JSON text. An .h5 file has checksums too: the attribute
``checksum`` of all others, and the dataset ``checksum`` of each tick's rows (Fletcher-32 covers whole chunks, whose
older rows a kill would lose).
"""

from __future__ import annotations

import io
import json
import os
import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, fields, replace
from functools import partial
from pathlib import Path
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Any, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid.arrays.array_types import Document, Kind, Rows
from batchpid.checks.validate import file_path, instance, integer
from batchpid.errors import BatchPIDError, InvalidArgumentError, MissingDependencyError
from batchpid.io.files import read_npz, write_atomically
from batchpid.sim.command import CommandSpec
from batchpid.sim.loop.faults import Fault
from batchpid.sim.observation import RECORDED, Observation, Redraw, Rollout, RunInfo
from batchpid.sim.recording.hdf5 import NOT_WRITTEN, read_hdf5

if TYPE_CHECKING:
    import h5py

FORMAT = "batchpid-recording-1"
HDF5 = (".h5", ".hdf5")
_DRAW = "draw."  # in front of the names of draws
_TEXTS = ("versions", "randomization", "sweep", "options")  # mappings, as JSON
_COMMAND_NAMES, _COMMAND_UNITS = "command_names", "command_units"
CHUNK_BYTES = 1 << 18  # approximate size of a chunk of an .h5 file
DTYPES: Document = {"time": np.float64} | {name: quantity.dtype for name, quantity in RECORDED.items()}
"""Dtype of each array of a recording."""


class RecordingError(BatchPIDError, OSError):
    """A recording cannot be written or read; the message names the file and the cause."""


def write_recording(
    rollout: Rollout, path: str | os.PathLike[str], *, seed: int | None = None, overwrite: bool = False
) -> Path:
    """Write ``rollout`` to ``path`` as a whole or not at all, making its folder, and return the path.

    Parameters
    ----------
    path
        File to write, ending in .npz (compressed), .h5 or .hdf5.
    seed
        Seed of the run, kept in the recording; default: the seed in ``rollout.info``.
    overwrite
        Whether an existing file is replaced.

    Raises
    ------
    InvalidArgumentError
        The file exists already, or its name ends otherwise.
    MissingDependencyError
        h5py is not installed, which .h5 files need.
    RecordingError
        The file cannot be written.
    """
    instance("rollout", rollout, Rollout, "pass what runner.rollout() returned")
    path = check_path(path, (".npz", *HDF5), overwrite=overwrite)
    info = rollout.info if seed is None else replace(rollout.info, seed=integer("seed", seed, 0, 2**63 - 1))
    h5py = None if path.suffix.lower() == ".npz" else load_h5py()

    def write(file: Any) -> None:
        if h5py is None:
            tables: Document = rollout.arrays() | _attributes(info, rollout.num_envs, rollout.tick)
            np.savez_compressed(file, **tables)
            return
        whole = io.BytesIO()  # HDF5 can crash the process after a write that failed
        with h5py.File(whole, "w", libver="latest") as opened:
            append_rows(create_datasets(opened, info, rollout.num_envs, rollout.tick), rollout.arrays())
        file.write(whole.getbuffer())

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, write, overwrite)
    except FileExistsError:
        raise RecordingError(f"{path}: was made by another program meanwhile; give another name") from None
    except OSError as error:
        raise RecordingError(f"{path}: cannot be written: {error.strerror or error}") from error
    return path


def read_recording(path: str | os.PathLike[str], *, every: int = 1, max_bytes: int | None = None) -> Rollout:
    """Read a recording: complete, cut short by a kill (``NAME.h5.partial``), or one that is still being written.

    ``info.complete`` of the result says whether the run came to its end. The file may come from a stranger: nothing in
    it is executed, no other file is opened, and checksums are verified.

    Parameters
    ----------
    path
        An .npz or .h5 file of any name.
    every
        Keep every n-th tick.
    max_bytes
        Largest size of the arrays in the file; default 1 GiB, or eight times the size of the file if that is more.

    Raises
    ------
    RecordingError
        The file is missing, damaged, too large, or no recording.
    MissingDependencyError
        h5py is not installed, which .h5 files need.
    """
    path, every = file_path("path", path), integer("every", every, 1, 10**9)
    max_bytes = None if max_bytes is None else integer("max_bytes", max_bytes, 0, 2**63 - 1)
    try:
        if path.is_dir():
            raise RecordingError(f"{path}: is a folder, not a recording")
        if not path.is_file():
            raise RecordingError(f"{path}: there is no such file; after a kill look for {path.name}.partial")
        limit = max(1 << 30, 8 * path.stat().st_size) if max_bytes is None else max_bytes
        with path.open("rb") as file:
            zipped = file.read(2) == b"PK"
        if zipped:
            attributes = read_npz(path, limit)
            arrays = {name: attributes.pop(name)[::every] for name in DTYPES if name in attributes}
        else:
            load_h5py()
            arrays, attributes = read_hdf5(path, ("checksum", *DTYPES), every, limit)
        checksums = arrays.pop("checksum", None)
        present = DTYPES.keys() & arrays.keys()
        if "guarded" not in arrays and "qpos" in arrays:  # recorded before there were guards
            arrays["guarded"] = np.zeros(arrays["qpos"].shape, bool)
        info = _info(attributes)
        dtypes = {name: DTYPES[name] for name in ("time", *info.recorded)}
        if lacking := dtypes.keys() - arrays:
            raise ValueError(f"it does not hold {', '.join(sorted(lacking))}")
        arrays = {name: arrays[name].astype(dtype, casting="same_kind", copy=False) for name, dtype in dtypes.items()}
        tick = float(attributes["tick"] if "tick" in attributes else attributes["timestep"] * attributes["substeps"])
        _check(arrays, tick, info)
        if checksums is not None and not np.array_equal(
            checksums, row_checksums({name: rows for name, rows in arrays.items() if name in present})
        ):
            raise ValueError("its data are damaged: a checksum differs")
    except (RecordingError, MissingDependencyError):
        raise
    except Exception as error:  # a damaged file can make the libraries raise anything
        raise RecordingError(f"{path}: cannot be read as a recording: {error or type(error).__name__}") from error
    time, setpoint = (arrays.pop(name) for name in ("time", "setpoint"))
    return Rollout(time, setpoint, Observation(**arrays), tick * every, info)


def check_path(path: str | os.PathLike[str], suffixes: tuple[str, ...], *, overwrite: bool) -> Path:
    """Return ``path`` if a recording can be written there.

    Raises
    ------
    InvalidArgumentError
        It ends in none of ``suffixes``, or the file exists and ``overwrite`` is False.
    """
    path = file_path("path", path, suffixes)
    if os.path.lexists(path) and not overwrite:
        raise InvalidArgumentError(
            "path", "exists already", value=str(path), remedy="choose another name, or pass overwrite=True"
        )
    return path


def load_h5py() -> Any:
    """Return the package h5py; raise MissingDependencyError if it is not installed."""
    try:
        import h5py
    except ImportError:
        raise MissingDependencyError("h5py", "recording to HDF5", "record") from None
    return h5py


def create_datasets(file: h5py.File, info: RunInfo, num_envs: int, tick: float) -> dict[str, h5py.Dataset]:
    """Write ``info`` to a new .h5 file, and return empty datasets that can grow: time and :attr:`RunInfo.recorded`."""
    for name, value in _attributes(info, num_envs, tick).items():
        file.attrs[name] = value
    datasets = {"time": file.create_dataset("time", (0,), "f8", maxshape=(None,), chunks=(1024,), fillvalue=np.nan)}
    datasets["time"].attrs["unit"] = ["s"]
    for name, quantity in info.recorded.items():
        row = info.row_shape(name, num_envs)
        dtype = np.dtype(quantity.dtype)
        rows = max(1, CHUNK_BYTES // (int(np.prod(row)) * dtype.itemsize))
        datasets[name] = file.create_dataset(name, (0, *row), dtype, maxshape=(None, *row), chunks=(rows, *row))
        if info.units_of(name):
            datasets[name].attrs["unit"] = list(info.units_of(name))
    datasets["checksum"] = file.create_dataset(
        "checksum", (0,), "i8", maxshape=(None,), chunks=(1024,), fillvalue=NOT_WRITTEN
    )
    return datasets


def append_rows(datasets: Mapping[str, h5py.Dataset], arrays: Mapping[str, Rows]) -> None:
    """Append ``arrays``, ticks first, to the datasets of their names; their checksums, which readers count, last."""
    arrays = {name: np.ascontiguousarray(arrays[name], dtype) for name, dtype in DTYPES.items() if name in datasets}
    for name, rows in (arrays | {"checksum": row_checksums(arrays)}).items():
        dataset = datasets[name]
        done = len(dataset)
        dataset.resize(done + len(rows), axis=0)
        dataset[done:] = rows
        dataset.flush()


def row_checksums(arrays: Mapping[str, Rows]) -> NDArray[np.int64]:
    """Return the CRC-32 of each tick's rows of all ``arrays``, (ticks,)."""
    sums = np.zeros(len(arrays["time"]), np.int64)
    for tick, rows in enumerate(zip(*map(np.ascontiguousarray, arrays.values()), strict=True)):
        for row in rows:
            sums[tick] = zlib.crc32(row, sums[tick])
    return sums


def attribute_checksum(attributes: Document) -> int:
    """Return the CRC-32 of all ``attributes`` but the checksum."""
    values = {name: np.asarray(value).tolist() for name, value in attributes.items() if name != "checksum"}
    return zlib.crc32(json.dumps(values, sort_keys=True).encode())


def faults_text(faults: Iterable[Fault]) -> str:
    """Return ``faults`` as the JSON text that a recording holds."""
    return json.dumps([fault._asdict() for fault in faults])


def redraws_text(redraws: Iterable[Redraw]) -> str:
    """Return ``redraws`` as the JSON text that a recording holds."""
    return json.dumps([list(redraw) for redraw in redraws])


def _attributes(info: RunInfo, num_envs: int, tick: float) -> Document:
    """Return the known fields of ``info`` as numbers, texts, and arrays of them."""
    known = {name: value for name, value in vars(info).items() if value is not None and name != "description"}
    known |= {name: list(value) for name, value in known.items() if isinstance(value, tuple)}
    known["faults"] = faults_text(info.faults)
    if (command := known.pop("own_command", None)) is not None:
        known |= {_COMMAND_NAMES: list(command.names), _COMMAND_UNITS: list(command.units)}
    if info.params is not None:
        known["params"] = bp.dumps_params(info.params, info.joint_names, format="json")
    if info.actuators is not None:
        known["actuators"] = bp.motors.dumps_actuators(info.actuators, info.joint_names, format="json")
    for name in _TEXTS:
        if name in known:
            known[name] = json.dumps(dict(known[name]))
    known["redraws"] = redraws_text(info.redraws)
    known |= {f"{_DRAW}{name}": rows for name, rows in known.pop("draws", {}).items()}
    known |= {"format": FORMAT, "num_envs": num_envs, "tick": tick}
    return known | {"checksum": attribute_checksum(known)}


def _info(attributes: Document) -> RunInfo:
    """Return the :class:`RunInfo` in the attributes of a recording."""
    if (found := str(attributes.get("format", FORMAT))) != FORMAT:
        raise ValueError(f"its format is {found!r}, not {FORMAT!r}")
    known = {
        field.name: attributes[field.name]
        for field in fields(RunInfo)
        if field.name in attributes.keys() - {"description"}
    }
    if lacking := [field.name for field in fields(RunInfo) if field.default is MISSING and field.name not in known]:
        raise ValueError(f"it does not say its {', '.join(lacking)}")
    if "checksum" in attributes and attributes["checksum"] != attribute_checksum(attributes):
        raise ValueError("its attributes are damaged: the checksum differs")
    names = tuple(map(str, known["joint_names"]))
    readers: dict[str, Callable[[Any], Any]] = {
        "params": lambda text: bp.loads_params(str(text), names)[0],
        "actuators": lambda text: bp.motors.loads_actuators(str(text), names)[0],
        "seed": lambda value: None if str(value) == "none" else int(value),
        "redraws": lambda text: tuple(Redraw(*redraw) for redraw in json.loads(str(text))),
        "faults": lambda text: tuple(Fault(**fault) for fault in json.loads(str(text))),
    }
    kinds = get_type_hints(RunInfo)
    for name in ("units", "lower", "upper", "effort_limit"):
        if np.shape(known[name]) != (len(names),):
            raise ValueError(f"its {name} are {np.shape(known[name])}, not one for each of {len(names)} joints")
    draws = {name.removeprefix(_DRAW): _numbers(rows) for name, rows in attributes.items() if name.startswith(_DRAW)}
    command = None
    if _COMMAND_NAMES in attributes:
        command = CommandSpec(attributes[_COMMAND_NAMES].tolist(), attributes[_COMMAND_UNITS].tolist())
    return RunInfo(
        **{name: readers.get(name, partial(_plain, kinds[name]))(value) for name, value in known.items()},
        draws=draws or None,
        own_command=command,
    )


def _plain(kind: Kind, value: Rows) -> Any:
    """Return a value of a field of :class:`RunInfo` of this type: a text, number, bool, array, names, or a mapping."""
    if isinstance(kind, UnionType):
        kind = next(each for each in get_args(kind) if each is not NoneType)
    if kind in (str, float, int, bool):
        return kind(value)
    if get_origin(kind) is Mapping:
        return dict(json.loads(str(value)))
    return tuple(map(str, value)) if kind == tuple[str, ...] else _numbers(value)


def _numbers(value: Rows) -> Rows:
    if value.dtype.kind not in "iuf":
        raise ValueError(f"it has {value.dtype} in place of numbers")
    return value


def _check(arrays: Mapping[str, Rows], tick: float, info: RunInfo) -> None:
    """Check that shapes agree and times are numbers."""
    ticks, dof = len(arrays["time"]), len(info.joint_names)
    envs = arrays["ok"].shape[-1] if arrays["ok"].ndim else 0
    shapes = {name: (ticks, *info.row_shape(name, envs)) for name in info.recorded}
    for name, shape in ({"time": (ticks,)} | shapes).items():
        if arrays[name].shape != shape:
            raise ValueError(f"its {name} has shape {arrays[name].shape}, not {shape}")
    if not (0 < tick < np.inf and np.isfinite(arrays["time"]).all()):
        raise ValueError("its times are not finite")
    if info.start is not None and info.start.shape != (envs, dof):
        raise ValueError(f"its start has shape {info.start.shape}, not {(envs, dof)}")
    if info.episodes is not None and info.episodes.shape != (envs, 2):
        raise ValueError(f"its episodes have shape {info.episodes.shape}, not {(envs, 2)}")
    for name, rows in (info.draws or {}).items():
        if rows.ndim != 2 or len(rows) != envs:
            raise ValueError(f"its draws of {name} have shape {rows.shape}, not one row for each of {envs} envs")
