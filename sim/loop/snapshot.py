"""Snapshots: the state of all envs, physics and controller, as arrays by name.

A snapshot is a barrier. The engine has more state than positions and velocities: contact caches,
warm starts, and the order in which it solves contacts. All of these depend on the past, and can be
neither read nor written. So every continuation from a snapshot, in this process or in another,
starts in a new world in that state, and the results are bit-identical. The barrier itself changes
the last bits.

A file is checked where a runner restores it: its arrays are compared with those of a fresh state of
that runner.
"""

from __future__ import annotations

import json
import os
import reprlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid.arrays.array_types import Document, Rows
from batchpid.arrays.trees import flatten
from batchpid.checks.validate import file_path, integer
from batchpid.errors import InvalidArgumentError
from batchpid.io.files import write_atomically
from batchpid.motors.friction import FrictionState
from batchpid.motors.guard import GuardState
from batchpid.sim.loop.acting_draws import effective
from batchpid.sim.loop.custom import initial_state
from batchpid.sim.loop.env_parts import COUNTS
from batchpid.sim.loop.faults import CAUSES, COMMAND_CAUSES, FaultContainment
from batchpid.sim.loop.step_values import StepState
from batchpid.sim.options.options import RunnerOptions
from batchpid.sim.signals.quantities import untouched

_FORMAT = 16
_DIGITS = 64
"""Length of a digest."""


@dataclass(frozen=True, eq=False)
class Snapshot:
    """State of all envs of a runner at one moment. It can be pickled, or kept in a file:
    :meth:`save`, :meth:`load`.
    """

    about: Document
    """Options that a runner must share to restore it:
    :meth:`batchpid.sim.RunnerOptions.describe`.
    """
    steps: int
    """Sim steps up to this moment."""
    params: bp.PIDParams
    rows: dict[str, Rows]
    """State of the envs, arrays (envs, ...) by name: :meth:`batchpid.sim.loop.env_group.EnvGroup.read`.

    Besides these there are ``motion``, the last joint setpoints and their rates (envs, 2, dof),
    where setpoints are for joints, and with a randomization ``episodes``, stream and episode of
    each env (envs, 2), from which everything is drawn again.
    """
    actuators: bp.Actuators | None = None

    def check_options(self, about: Mapping[str, Any]) -> None:
        """Raise InvalidArgumentError if a runner with options ``about`` cannot restore it."""
        different = [key for key, ours in about.items() if self.about.get(key) != ours]
        if not different:
            return
        key = different[0]
        ours = about[key]
        theirs = self.about.get(key)
        problem = f"{key} {reprlib.repr(theirs)}, not {reprlib.repr(ours)}"
        if _DIGITS in (len(str(ours)), len(str(theirs))):
            problem = f"another {key}"
        problem = ", and another ".join([problem, *different[1:]])
        remedy = "restore it in a runner made with the same options"
        raise InvalidArgumentError("snapshot", f"is of a runner with {problem}", remedy=remedy)

    def check_rows(self, fresh: Mapping[str, Rows], command_size: int) -> None:
        """Compare the arrays with the ``fresh`` ones of the runner that restores them.

        ``command_size`` is the size of a setpoint. Values of the engine that are NaN in ``fresh``
        are beyond the state of their env.

        Raises
        ------
        InvalidArgumentError
            An array is missing, unknown, or of another shape, dtype or range.
        """
        ours, theirs = _kinds(fresh), _kinds(self.rows)
        for name in ours | theirs:
            kind, other = theirs.get(name), ours.get(name)
            _expect(kind == other, f"has {kind} for {name}, not {other}")
        joint = self.rows["containment/joint"]
        cause = self.rows["containment/cause"]
        of_command = np.isin(cause, [CAUSES.index(name) for name in COMMAND_CAUSES])
        joints = np.where(of_command, command_size, self.rows["effort"].shape[1])
        is_fault = (joint >= 0) & (joint < joints) & (cause >= 0) & (cause < len(CAUSES))
        _expect(is_fault.all(), "has a fault of an unknown joint or cause")
        beyond = self.rows["engine"][np.isnan(fresh["engine"])]
        _expect(np.isnan(beyond).all(), "holds other content than this runner's build makes")

    def episodes(self, num_envs: int) -> NDArray[np.int64]:
        """Return the checked stream and episode of each of ``num_envs`` envs."""
        episodes = self.rows.get("episodes", np.zeros(0))
        is_table = episodes.shape == (num_envs, 2) and episodes.dtype == np.int64
        _expect(is_table and (episodes >= 0).all(), "has no valid episodes of its envs")
        return episodes

    def for_envs(self, envs: slice | Sequence[int] | Rows) -> Snapshot:
        """Return a snapshot of the envs with these numbers, in this order, and repeatedly where a
        number repeats.

        A runner of as many envs restores it. An env continues bit by bit as the original would,
        with the noise of the original's sensors, until it is reset.

        Raises
        ------
        IndexError
            A number is not one of an env.
        """
        envs = np.arange(len(self.rows["effort"]))[envs]
        return replace(
            self,
            about=self.about | {"num_envs": len(envs)},
            params=self.params.for_envs(envs),
            rows={name: rows[envs] for name, rows in self.rows.items()},
            actuators=None if self.actuators is None else self.actuators.for_envs(envs),
        )

    def copy(self) -> Snapshot:
        """Return a snapshot with arrays of its own."""
        return self.for_envs(slice(None))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write an .npz file, as a whole or not at all: an older file stays until this one is
        complete.

        Raises
        ------
        OSError
            The file cannot be written.
        """
        joints = self.about["joints"]
        head = {"format": _FORMAT, "about": self.about, "steps": self.steps}
        head["params"] = bp.dumps_params(self.params, joints, format="json")
        if self.actuators is not None:
            head["actuators"] = bp.motors.dumps_actuators(self.actuators, joints, format="json")
        tables: Document = {"head": np.array(json.dumps(head))} | self.rows
        write_atomically(file_path("path", path), lambda file: np.savez(file, **tables))

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Snapshot:
        """Read a file of :meth:`save`. Nothing in it is executed.

        Raises
        ------
        InvalidArgumentError
            The file is missing, damaged, or no snapshot of this version.
        """
        path = file_path("path", path)
        try:
            if not path.is_file():
                raise ValueError("there is no such file")
            with path.open("rb") as file, np.load(file, allow_pickle=False) as tables:
                return cls._read(dict(tables))
        except Exception as error:  # a damaged file can make the libraries raise anything
            raise InvalidArgumentError(
                "path",
                f"cannot be read as a snapshot: {error or type(error).__name__}",
                value=str(path),
                remedy="pass a file that Snapshot.save wrote",
            ) from error

    @classmethod
    def _read(cls, rows: dict[str, Rows]) -> Snapshot:
        """Return the snapshot in the arrays of a file."""
        head = json.loads(str(rows.pop("head")))
        if head["format"] != _FORMAT:
            raise ValueError(f"format {head['format']}, not {_FORMAT}")
        about: Document = dict(head["about"])
        steps = integer("steps", head["steps"], 0, 2**62)
        params, _ = bp.loads_params(head["params"], about["joints"])
        actuators = None
        if "actuators" in head:
            actuators, _ = bp.motors.loads_actuators(head["actuators"], about["joints"])
        return cls(about, steps, params, rows, actuators)

    def __repr__(self) -> str:
        about = self.about
        return (
            f"Snapshot({about.get('robot')}, {about.get('num_envs')} envs, control"
            f" {about.get('control')!r}, after {self.steps} sim steps)"
        )


def join_rows(parts: Sequence[dict[str, Rows]]) -> dict[str, Rows]:
    """Return the state of the envs of all ``parts``; the engine's values are as many as the most
    of an env, with NaN after those of an env with fewer.
    """
    if len(parts) == 1:
        return parts[0]
    joined = {
        name: np.concatenate([part[name] for part in parts])
        for name in parts[0]
        if name != "engine"
    }
    # Content of ``build`` differs between envs.
    engine = [row for part in parts for row in part["engine"]]
    return joined | {"engine": _table(engine)}


def _table(rows: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return rows of different lengths as a table, with NaN at the end of the shorter ones."""
    table = np.full((len(rows), max(map(len, rows))), np.nan)
    for line, row in zip(table, rows, strict=True):
        line[: len(row)] = row
    return table


def fresh_rows(
    options: RunnerOptions,
    params: bp.PIDParams,
    actuators: bp.Actuators | None,
    engine_sizes: Sequence[int],
) -> dict[str, Rows]:
    """Return arrays in the names, shapes and dtypes of a snapshot of a runner with ``options`` under
    these ``params`` and ``actuators``.

    ``engine_sizes`` (envs,) are the numbers of values in the engine's states; the others are NaN.
    """
    num_envs = options.num_envs
    counts = np.zeros(num_envs, np.int64)
    table = np.zeros((num_envs, options.robot.dof))
    mask = np.zeros(table.shape, bool)
    state = StepState(initial_state(options, params))
    motors = effective(actuators)
    if motors is not None:
        state = state._replace(motors=bp.motors.init(motors, table, options.timestep))
    if options.has_stiction(actuators):
        friction = FrictionState(*[table] * len(FrictionState._fields))
        state = state._replace(friction=friction, age=counts)
    if options.guard is not None:
        state = state._replace(guard=GuardState(table, table))
    tree: Document = {
        "engine": _table([np.zeros(size) for size in engine_sizes]),
        "effort": table.astype(np.float32),
        "saturated": mask,
        "guarded": mask,
        "episode": counts,
        "control": state,
        "containment": FaultContainment(*table.shape, "hold").state,
        "sensors": untouched(num_envs, options.observed),
    }
    if options.has_pushes:
        tree["pushes"] = dict.fromkeys(COUNTS, counts)
    if options.sets_positions:
        tree["motion"] = np.stack([table, table], axis=1)
    if options.randomization is not None:
        tree["episodes"] = np.stack([counts, counts], axis=1)
    return flatten(tree)


def _kinds(rows: Mapping[str, Rows]) -> dict[str, str]:
    """Return dtype and shape of arrays."""
    return {name: f"{table.dtype.str} {table.shape}" for name, table in rows.items()}


def _expect(holds: Any, problem: str) -> None:
    """Raise InvalidArgumentError with a ``problem`` of a snapshot unless something ``holds``."""
    if not holds:
        raise InvalidArgumentError("snapshot", problem, remedy="take a new one")
