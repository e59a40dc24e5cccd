"""Rollouts in files: written as a whole, or tick by tick by :class:`sim.Recorder`, and read back.

A file is .npz (NumPy) or .h5 (HDF5). Both hold the arrays of a :class:`sim.Rollout` under their names, ticks first, and
what is known of its :class:`sim.RunInfo`: as further arrays in an .npz file, as attributes of an .h5 file. ``params``,
``versions`` and ``faults`` are JSON text.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import MISSING, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid.errors import BatchPIDError, InvalidArgumentError, MissingDependencyError
from batchpid.files import write_atomically
from batchpid.validate import file_path, instance, integer
from sim.loop.faults import Fault
from sim.observation import RECORDED, Observation, Rollout, RunInfo

if TYPE_CHECKING:
    import h5py

FORMAT = "batchpid-recording-1"
HDF5 = (".h5", ".hdf5")
CHUNK_BYTES = 1 << 18
"""Approximate size of a chunk of an .h5 file."""


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
        Seed of the run, kept in the recording; default that of ``rollout.info``.
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
    h5py = None if path.suffix == ".npz" else load_h5py()

    def write(file: Any) -> None:
        if h5py is None:
            tables: dict[str, Any] = rollout.arrays() | _attributes(info, rollout.num_envs, rollout.tick)
            np.savez_compressed(file, **tables)
            return
        with h5py.File(file, "w", libver="latest") as opened:
            append_rows(create_datasets(opened, info, rollout.num_envs, rollout.tick), rollout.arrays())

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, write)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be written: {error}") from error
    return path


def read_recording(path: str | os.PathLike[str], *, every: int = 1) -> Rollout:
    """Read a recording: complete, cut short by a kill (``NAME.h5.partial``), or one that is still being written.

    ``info.complete`` of the result says whether the run came to its end.

    Parameters
    ----------
    path
        An .npz file, or an .h5 file of any name.
    every
        Keep every n-th tick.

    Raises
    ------
    RecordingError
        The file is missing, or no recording.
    MissingDependencyError
        h5py is not installed, which .h5 files need.
    """
    path, every = file_path("path", path), integer("every", every, 1, 10**9)
    try:
        if not path.is_file():
            raise RecordingError(f"{path}: there is no such file; after a kill look for {path.name}.partial")
        with _open(path) as (arrays, attributes):
            info = _info(attributes)
            tick = attributes.get("tick")  # older files may lack it
            tick = float(attributes["timestep"] * attributes["substeps"] if tick is None else tick)
            time = arrays["time"][:]
            ticks = slice(0, int(np.isfinite(time).sum()), every)  # times that are not written yet are NaN
            tables = {name: arrays[name][ticks] for name in RECORDED}
            _check_shapes(tables, len(time[ticks]), len(info.joint_names))
            setpoint, *seen = (tables[name].astype(RECORDED[name].dtype, casting="same_kind") for name in RECORDED)
    except (RecordingError, MissingDependencyError):
        raise
    except Exception as error:  # a damaged file can make the libraries raise anything
        raise RecordingError(f"{path}: cannot be read as a recording: {error}") from error
    return Rollout(time[ticks], setpoint, Observation(*seen), tick * every, info)


def check_path(path: str | os.PathLike[str], suffixes: tuple[str, ...], *, overwrite: bool) -> Path:
    """Return ``path`` if a recording can be written there.

    Raises
    ------
    InvalidArgumentError
        It ends in none of ``suffixes``, or the file exists and ``overwrite`` is False.
    """
    path = file_path("path", path, suffixes)
    if path.exists() and not overwrite:
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
    """Write ``info`` to a new .h5 file, and return empty datasets that can grow: time and all of :data:`RECORDED`."""
    for name, value in _attributes(info, num_envs, tick).items():
        file.attrs[name] = value
    datasets = {"time": file.create_dataset("time", (0,), "f8", maxshape=(None,), chunks=(1024,), fillvalue=np.nan)}
    datasets["time"].attrs["unit"] = ["s"]
    for name, quantity in RECORDED.items():
        row = (num_envs, len(info.joint_names)) if quantity.per_joint else (num_envs,)
        dtype = np.dtype(quantity.dtype)
        rows = max(1, CHUNK_BYTES // (int(np.prod(row)) * dtype.itemsize))
        datasets[name] = file.create_dataset(name, (0, *row), dtype, maxshape=(None, *row), chunks=(rows, *row))
        if quantity.per_joint:
            datasets[name].attrs["unit"] = [info.quantity(name).unit_for(unit) for unit in info.units]
    return datasets


def append_rows(datasets: Mapping[str, h5py.Dataset], arrays: Mapping[str, NDArray[Any]]) -> None:
    """Append ``arrays``, ticks first, to the datasets of their names; to time, which readers count, last."""
    for name in (*RECORDED, "time"):
        dataset, rows = datasets[name], arrays[name]
        done = len(dataset)
        dataset.resize(done + len(rows), axis=0)
        dataset[done:] = rows
        dataset.flush()


def faults_text(faults: Iterable[Fault]) -> str:
    """Return ``faults`` as the JSON text that a recording holds."""
    return json.dumps([fault._asdict() for fault in faults])


def _attributes(info: RunInfo, num_envs: int, tick: float) -> dict[str, Any]:
    """Return what is known of a run as numbers, texts, and arrays of them."""
    known = {name: value for name, value in vars(info).items() if value is not None}
    known |= {"joint_names": list(info.joint_names), "units": list(info.units), "faults": faults_text(info.faults)}
    if info.params is not None:
        known["params"] = bp.dumps_params(info.params, info.joint_names, format="json")
    if info.versions is not None:
        known["versions"] = json.dumps(dict(info.versions))
    return {"format": FORMAT, "num_envs": num_envs, "tick": tick} | known


@contextmanager
def _open(path: Path) -> Iterator[tuple[Mapping[str, Any], Mapping[str, Any]]]:
    """Open a recording; its arrays, which can be sliced, and its attributes."""
    if path.suffix == ".npz":
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as arrays:
            yield arrays, arrays
        return
    h5py = load_h5py()
    try:
        file = h5py.File(path, "r")
    except OSError:
        file = h5py.File(path, "r", swmr=True, libver="latest")  # it is being written, or its writer was killed
    with file:
        yield file, file.attrs


def _info(attributes: Mapping[str, Any]) -> RunInfo:
    """Return what the attributes of a recording say of its run."""
    if (found := str(attributes.get("format", FORMAT))) != FORMAT:
        raise ValueError(f"its format is {found!r}, not {FORMAT!r}")
    known = {field.name: attributes[field.name] for field in fields(RunInfo) if field.name in attributes}
    if lacking := [field.name for field in fields(RunInfo) if field.default is MISSING and field.name not in known]:
        raise ValueError(f"it does not say its {', '.join(lacking)}")
    names = tuple(map(str, known["joint_names"]))
    decode: dict[str, Callable[[Any], Any]] = {
        **dict.fromkeys(("joint_names", "units"), lambda value: tuple(map(str, value))),
        **dict.fromkeys(("lower", "upper", "effort_limit", "start"), np.asarray),
        "params": lambda text: bp.loads_params(str(text), names)[0],
        "seed": lambda value: None if str(value) == "none" else int(value),
        "versions": lambda text: json.loads(str(text)),
        "faults": lambda text: tuple(Fault(**fault) for fault in json.loads(str(text))),
    }
    for name in ("units", "lower", "upper", "effort_limit"):
        if np.shape(known[name]) != (len(names),):
            raise ValueError(f"its {name} are {np.shape(known[name])}, not one for each of {len(names)} joints")
    return RunInfo(**{name: decode.get(name, lambda one: np.asarray(one).item())(known[name]) for name in known})


def _check_shapes(tables: Mapping[str, NDArray[Any]], ticks: int, dof: int) -> None:
    envs = tables["ok"].shape[1]
    for name, quantity in RECORDED.items():
        shape = (ticks, envs, dof) if quantity.per_joint else (ticks, envs)
        if tables[name].shape != shape:
            raise ValueError(f"its {name} has shape {tables[name].shape}, not {shape}")
