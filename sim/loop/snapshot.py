"""Snapshots: the whole state of all envs, physics and controller, as arrays.

A snapshot is a barrier. The engine keeps more than positions and velocities: contact caches, warm starts, and the order
in which it solves contacts, all of which depend on its past and can be neither read nor written. So whoever goes on
from a snapshot, in the process that took it or in another, goes on with a new world in that state, and gets the same
bytes. The barrier itself changes the last bits.
"""

from __future__ import annotations

import json
import os
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid.choices import CHOICE_TYPES
from batchpid.errors import InvalidArgumentError
from batchpid.files import write_atomically
from sim.loop.faults import CAUSES, FaultContainment

_FORMAT = 3


@dataclass(frozen=True)
class EnvStates:
    """State of some envs; every array has a row for each."""

    qpos: NDArray[np.float32]
    qvel: NDArray[np.float32]
    effort: NDArray[np.float32]
    root: NDArray[np.float32]
    """Position, quaternion w, x, y, z, linear and angular velocity of the root link (envs, 13)."""
    content: NDArray[np.float32]
    """What the caller's content needs (envs, numbers); NaN where an env needs fewer than another."""
    isolated: NDArray[np.bool_]
    """Whether the robot has a PhysX system of its own (:mod:`sim.engine.contact_prediction`)."""
    saturated: NDArray[np.bool_]
    controller: dict[str, NDArray[Any]]
    """Leaves of :class:`batchpid.PIDState`."""
    containment: dict[str, NDArray[Any]]
    """See :class:`sim.loop.faults.FaultContainment`."""

    def for_envs(self, envs: slice) -> EnvStates:
        """The state of some of the envs, as copies."""
        return _build({name: rows[envs].copy() for name, rows in _flatten(self)})

    def check(self, num_envs: int, dof: int, params: bp.PIDParams, sizes: Sequence[int]) -> None:
        """Check that these are states of so many envs and joints under such params, with content of such sizes (envs,).

        Raises
        ------
        InvalidArgumentError
            They are not.
        """
        row, table = np.zeros((num_envs, 13), np.float32), np.zeros((num_envs, dof), np.float32)
        wanted: dict[str, Any] = dict.fromkeys(("qpos", "qvel", "effort"), table)
        wanted |= {
            "root": row,
            "isolated": row[:, 0] > 0,
            "saturated": table > 0,
            "content": self.content[:num_envs],
        }
        known = FaultContainment(num_envs, dof, "hold", None).read()
        wanted |= {f"containment.{name}": rows for name, rows in known.items()}
        found = dict(_flatten(self))
        remembered = bp.init(params, table)._asdict()
        wanted |= {f"controller.{name}": leaf for name, leaf in remembered.items() if leaf is not None}
        for name in sorted(set(wanted) | set(found)):
            ours, theirs = wanted.get(name), found.get(name)
            if ours is None or theirs is None:
                problem = "no " + name if theirs is None else f"an unknown {name}"
            elif ours.shape != theirs.shape or ours.dtype.kind != theirs.dtype.kind:
                problem = f"{name} of {theirs.dtype} {theirs.shape}, not {ours.dtype} {ours.shape}"
            else:
                continue
            raise InvalidArgumentError("snapshot", f"has {problem}", remedy="take a new one")
        for name, count in (("joint", dof), ("cause", len(CAUSES))):
            if not ((self.containment[name] >= 0) & (self.containment[name] < count)).all():
                raise InvalidArgumentError("snapshot", f"names a {name} beyond {count}", remedy="take a new one")
        for env, size in enumerate(sizes):
            if size > self.content.shape[1] or not np.isnan(self.content[env, size:]).all():
                raise InvalidArgumentError(
                    "snapshot",
                    "holds other content than this runner's build makes",
                    env=env,
                    remedy="make the runner with the same build=",
                )

    @staticmethod
    def join(parts: Sequence[EnvStates]) -> EnvStates:
        """The states of the envs of all ``parts``."""
        width = max(part.content.shape[1] for part in parts)
        parts = [replace(part, content=_widen(part.content, width)) for part in parts]
        tables = [dict(_flatten(part)) for part in parts]
        return _build({name: np.concatenate([table[name] for table in tables]) for name in tables[0]})


@dataclass(frozen=True)
class Snapshot:
    """State of all envs of a runner at one moment. It can be pickled, or kept in a file: :meth:`save`, :meth:`load`."""

    about: dict[str, Any]
    """What the runner was made of, as far as a snapshot fits no other."""
    steps: int
    """Sim steps up to this moment."""
    params: bp.PIDParams
    states: EnvStates

    def check(self, about: dict[str, Any]) -> None:
        """Check that it is of a runner of which all this is true.

        Raises
        ------
        InvalidArgumentError
            It does not.
        """
        for key, ours in about.items():
            if self.about.get(key) != ours:
                raise InvalidArgumentError(
                    "snapshot",
                    f"is of a runner with {key} {self.about.get(key)!r}, not {ours!r}",
                    remedy="restore it in a runner made with the same options",
                )

    def for_envs(self, envs: slice) -> Snapshot:
        """The part of some envs."""
        return replace(self, params=self.params.for_envs(envs), states=self.states.for_envs(envs))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write to an .npz file, beside it first, so that an older file stays whole until this one is."""
        leaves = {name: leaf for name, leaf in self.params._asdict().items() if leaf is not None}
        arrays = {f"params.{name}": leaf for name, leaf in leaves.items() if not isinstance(leaf, tuple)}
        markers = {name: type(leaf).__name__ for name, leaf in leaves.items() if isinstance(leaf, tuple)}
        head = {"format": _FORMAT, "about": self.about, "steps": self.steps, "markers": markers}
        tables: dict[str, Any] = {"head": np.array(json.dumps(head))} | arrays | dict(_flatten(self.states))
        write_atomically(path, lambda file: np.savez(file, **tables))

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Snapshot:
        """Read what :meth:`save` wrote. Nothing in the file can run.

        Raises
        ------
        InvalidArgumentError
            The file is missing, or no snapshot of this version.
        """
        if not isinstance(path, str | os.PathLike):  # open() takes a number for a file descriptor
            raise InvalidArgumentError("path", "must be a path", value=path, remedy="pass the file's name")
        try:
            with open(path, "rb") as opened, np.load(opened, allow_pickle=False) as file:
                tables = {name: file[name] for name in file.files}
            head = json.loads(str(tables.pop("head")))
            if head["format"] != _FORMAT:
                raise ValueError(f"format {head['format']}, not {_FORMAT}")
            about, steps = head["about"], head["steps"]
            if not isinstance(about, dict) or not isinstance(steps, int) or not 0 <= steps < 2**62:
                raise ValueError("it does not say what it is of")
            params = {
                name.removeprefix("params."): tables.pop(name) for name in list(tables) if name.startswith("params.")
            }
            params |= {name: _marker(kind) for name, kind in head["markers"].items()}
            return cls(about, steps, bp.PIDParams(**params), _build(tables))
        except (
            OSError,
            ValueError,
            KeyError,
            TypeError,
            AttributeError,
            zipfile.BadZipFile,
            EOFError,
        ) as error:
            raise InvalidArgumentError(
                "path",
                f"cannot be read as a snapshot: {error}",
                value=str(path),
                remedy="pass a file that Snapshot.save wrote",
            ) from error


def _marker(kind: str) -> tuple[()]:
    known = {marker.__name__: marker for marker in CHOICE_TYPES}
    return known[kind]()


def _flatten(states: EnvStates) -> Iterator[tuple[str, NDArray[Any]]]:
    for item in fields(states):
        value = getattr(states, item.name)
        if isinstance(value, dict):
            yield from ((f"{item.name}.{name}", rows) for name, rows in value.items())
        else:
            yield item.name, value


def _build(tables: dict[str, NDArray[Any]]) -> EnvStates:
    items: dict[str, Any] = {"controller": {}, "containment": {}}
    for name, rows in tables.items():
        group, dot, leaf = name.partition(".")
        if dot:
            items[group][leaf] = rows
        else:
            items[name] = rows
    return EnvStates(**items)


def _widen(rows: NDArray[np.float32], width: int) -> NDArray[np.float32]:
    return np.pad(rows, ((0, 0), (0, width - rows.shape[1])), constant_values=np.nan)
