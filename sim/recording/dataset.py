"""Rollouts as labelled data: an ``xarray.Dataset`` with dimensions, units and names."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import numpy as np

from batchpid.arrays.array_types import Document
from batchpid.errors import MissingDependencyError
from batchpid.sim.observation import Rollout
from batchpid.sim.recording.recording_files import read_recording

if TYPE_CHECKING:
    import xarray


def to_dataset(rollout: Rollout) -> xarray.Dataset:
    """Return ``rollout`` as a dataset with dimensions time, env and joint.

    Coordinates: ``time`` [s], ``env``, ``joint`` (names) and ``unit`` (rad or m, by joint). Every variable has a
    ``long_name`` and ``units``; "rad|m" means the joint's own ``unit``. The setpoint of a control with a command of its
    own has the dimension ``entry`` in place of ``joint``, with the units ``entry_unit``. Quantities of links have the
    dimension ``contacts`` or ``wrenches`` (names). The arrays are not copied.

    Raises
    ------
    MissingDependencyError
        Without the ``xarray`` package.
    """
    try:
        import xarray
    except ImportError:
        raise MissingDependencyError("xarray", "a labelled dataset", "data") from None
    info, own, quantities = rollout.info, rollout.info.own_command, rollout.info.recorded
    columns = {name: ("joint",) if quantity.per_joint else () for name, quantity in quantities.items()}
    units = {name: quantity.unit for name, quantity in quantities.items()}
    entries: Document = {}
    if own is not None:
        columns["setpoint"], units["setpoint"] = ("entry",), "|".join(dict.fromkeys(own.units))
        entries = {
            "entry": list(own.names),
            "entry_unit": ("entry", list(own.units), {"long_name": "unit of the entry"}),
        }
    elif info.control == "effort":
        units["setpoint"] = units["effort"]
    for name, quantity in quantities.items():
        if quantity.columns:
            _, has_part, part = name.rpartition("_")  # "pose", "twist" or "force"
            part = part if has_part else "component"
            columns[name], entries[part] = (part,), list(quantity.columns)
        if quantity.option:
            columns[name], entries[quantity.option] = (quantity.option, *columns[name]), list(quantity.links)
    return xarray.Dataset(
        {
            name: (
                ("time", "env", *columns[name]),
                getattr(rollout, name),
                {"long_name": quantity.meaning, "units": units[name]},
            )
            for name, quantity in quantities.items()
        },
        coords={
            **entries,
            "time": ("time", rollout.time, {"long_name": "simulated time", "units": "s"}),
            "env": np.arange(rollout.num_envs),
            "joint": list(info.joint_names),
            "unit": ("joint", list(info.units), {"long_name": "unit of the joint's position"}),
        },
        attrs={"robot": info.robot},
    )


def open_dataset(path: str | os.PathLike[str]) -> xarray.Dataset:
    """Return the recording in a file as a dataset: :func:`batchpid.sim.read_recording`, :func:`to_dataset`."""
    return to_dataset(read_recording(path))
