"""Rollouts as labelled data: read back from a file, and as an ``xarray.Dataset`` with dimensions, units and names."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from batchpid.errors import InvalidArgumentError, MissingDependencyError
from batchpid.files import write_atomically
from sim.observation import OBSERVED, Observation, Rollout, RunInfo
from sim.recording.reader import read_recording
from sim.robot.robot import Robot

if TYPE_CHECKING:
    import xarray

_SAYS = {
    "setpoint": "setpoint",
    "qpos": "joint position",
    "qvel": "joint velocity",
    "effort": "applied joint effort",
    "saturated": "effort at its limit",
    "ok": "state is finite",
}


class Recorded(NamedTuple):
    """A rollout from a file, and what the file says of its robot; ``complete`` is False where it was cut short."""

    rollout: Rollout
    robot: str
    joint_names: tuple[str, ...]
    units: tuple[str, ...]
    """Of each joint's position: "rad" or "m"."""
    lower: NDArray[np.float64]
    """(joints,) [rad or m]."""
    upper: NDArray[np.float64]
    """(joints,) [rad or m]."""
    effort_limit: NDArray[np.float64]
    """(joints,) [N m or N]."""
    complete: bool = True


def write_rollout(path: str | Path, rollout: Rollout) -> None:
    """Write ``rollout`` to a .npz file, for :func:`read_rollout`.

    Raises
    ------
    OSError
        The file cannot be written; an older one is left as it was.
    """
    arrays: dict[str, Any] = {**rollout.arrays(), "tick": rollout.tick}
    for name in ("robot", "joint_names", "units", "lower", "upper", "effort_limit", "start"):
        arrays[name] = getattr(rollout.info, name)
    write_atomically(path, lambda file: np.savez_compressed(file, **arrays))


def read_rollout(path: str | Path, *, every: int = 1) -> Recorded:
    """Read what ``batchpid rollout --out FILE`` or a :class:`sim.Recorder` wrote: .npz, .h5 or .hdf5.

    Takes every ``every``-th tick.

    Raises
    ------
    InvalidArgumentError
        The file is not there, or holds something else.
    RecordingError
        So does the .h5 file.
    """
    path = Path(path)
    if path.suffix in (".h5", ".hdf5") or ".partial" in path.suffix:
        found = read_recording(path, every=every)
        seen = Observation._make(getattr(found, name) for name in OBSERVED)
        tick = float(found.attributes["timestep"]) * int(found.attributes["substeps"]) * every
        rollout = Rollout(found.time, found.setpoint, seen, tick, _info(found.attributes, found.complete))
        return _recorded(rollout, found.attributes, found.complete)
    if not path.is_file():
        raise InvalidArgumentError("path", "is no file", value=str(path), remedy="check the spelling")
    try:
        with np.load(path, allow_pickle=False) as data:
            seen = Observation._make(data[name][::every] for name in OBSERVED)
            tick = float(data["tick"]) * every
            rollout = Rollout(data["time"][::every], data["setpoint"][::every], seen, tick, _info(data))
            return _recorded(rollout, data)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise InvalidArgumentError(
            "path",
            f"cannot be read as a rollout: {error}",
            value=str(path),
            remedy="give a file that batchpid rollout --out wrote",
        ) from error


def _info(about: Mapping[str, Any], complete: bool = True) -> RunInfo:
    names, units = (tuple(map(str, about[name])) for name in ("joint_names", "units"))
    lower, upper, limit = (np.asarray(about[name], np.float64) for name in ("lower", "upper", "effort_limit"))
    return RunInfo(str(about["robot"]), names, units, lower, upper, limit, complete=complete)


def _recorded(rollout: Rollout, about: Mapping[str, Any], complete: bool = True) -> Recorded:
    names, units = (tuple(map(str, about[name])) for name in ("joint_names", "units"))
    lower, upper, limit = (np.asarray(about[name], np.float64) for name in ("lower", "upper", "effort_limit"))
    return Recorded(rollout, str(about["robot"]), names, units, lower, upper, limit, complete)


def to_dataset(rollout: Rollout, robot: Robot | Recorded) -> xarray.Dataset:
    """Return ``rollout`` as a dataset with dimensions time, env and joint.

    Coordinates: ``time`` [s], ``env``, ``joint`` (names) and ``unit`` (rad or m, by joint). Every variable has a
    ``long_name`` and ``units``; "rad|m" means the joint's own ``unit``. The arrays are not copied.

    Raises
    ------
    MissingDependencyError
        Without the ``xarray`` package.
    """
    try:
        import xarray
    except ImportError:
        raise MissingDependencyError("xarray", "a labelled dataset", "data") from None
    units = {"setpoint": "rad|m", "qpos": "rad|m", "qvel": "rad/s|m/s", "effort": "N m|N"}
    variables: dict[str, Any] = {}
    for name, says in _SAYS.items():
        dims = ("time", "env") if name == "ok" else ("time", "env", "joint")
        variables[name] = (dims, getattr(rollout, name), {"long_name": says, "units": units.get(name, "1")})
    title = robot.name if isinstance(robot, Robot) else robot.robot
    return xarray.Dataset(
        variables,
        coords={
            "time": ("time", rollout.time, {"long_name": "simulated time", "units": "s"}),
            "env": np.arange(rollout.qpos.shape[1]),
            "joint": list(robot.joint_names),
            "unit": ("joint", list(robot.units), {"long_name": "unit of the joint's position"}),
        },
        attrs={"robot": title},
    )


def open_dataset(path: str | Path) -> xarray.Dataset:
    """Return the rollout in a file as a dataset; see :func:`read_rollout` and :func:`to_dataset`."""
    recorded = read_rollout(path)
    return to_dataset(recorded.rollout, recorded)
