"""Snapshots: the state of all envs, physics and controller, as arrays by name.

A snapshot is a barrier. The engine has more state than positions and velocities: contact caches,
warm starts, and the order in which it solves contacts. All of these depend on the past, and can be
neither read nor written. So every continuation from a snapshot, in this process or in another,
starts in a new world in that state, and the results are bit-identical. The barrier itself changes
the last bits.

A file is checked where a runner restores it: its arrays are compared with a fresh state of that
runner.
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
from batchpid.sim.loop.faults import CAUSES, COMMAND_CAUSES, FaultContainment
from batchpid.sim.loop.pushes import COUNTS
from batchpid.sim.loop.step_values import StepState

_FORMAT = 15
_DIGITS = 64
"""Length of a digest."""
_TABLES = ("control", "containment", "sensors", "pushes")
"""Parts of :class:`EnvStates` that are arrays by name."""


@dataclass(frozen=True, eq=False)
class EnvStates:
    """State of some envs; every array has a row for each."""

    engine: NDArray[np.float64]
    """Robots and content (envs, values), of which only the engine knows the meaning; NaN where an
    env has fewer values than another
    (:meth:`batchpid.sim.engine.protocol.EnginePack.read_state`).
    """
    effort: NDArray[np.float32]
    saturated: NDArray[np.bool_]
    guarded: NDArray[np.bool_]
    """Setpoints that the guard changed in the last sim step."""
    episode: NDArray[np.int64]
    """Resets of each env with actuators (envs,)."""
    control: dict[str, Rows]
    """Arrays of :class:`batchpid.sim.loop.step_values.StepState` by name, such as
    "friction/gain".
    """
    containment: dict[str, Rows]
    """See :class:`batchpid.sim.loop.faults.FaultContainment`."""
    sensors: dict[str, Rows]
    """Quantities of :class:`batchpid.sim.Observation` from the sensors of links; none without such
    sensors.
    """
    pushes: dict[str, NDArray[np.int64]]
    """Counts of :class:`batchpid.sim.loop.pushes.Pushes`; none without pushes."""

    @classmethod
    def fresh(
        cls,
        num_envs: int,
        dof: int,
        *,
        law: dict[str, Rows],
        motors: dict[str, Rows],
        sensors: dict[str, Rows],
        stiction: bool,
        guard: bool,
        pushes: bool,
    ) -> EnvStates:
        """Return states of zeros, in the shapes and dtypes of ``num_envs`` envs of ``dof`` joints.

        ``stiction``, ``guard`` and ``pushes`` tell whether the envs have Coulomb friction, a guard
        and pushes; ``law``, ``motors`` and ``sensors`` are the states of these parts by name.
        """
        counts = np.zeros(num_envs, np.int64)
        rows = np.zeros((num_envs, dof))
        state = StepState(law, motors=motors)
        if stiction:
            friction = FrictionState(*[rows] * len(FrictionState._fields))
            state = state._replace(friction=friction, age=counts)
        if guard:
            state = state._replace(guard=GuardState(*[rows] * len(GuardState._fields)))
        return cls(
            engine=np.zeros((num_envs, 0)),
            effort=rows.astype(np.float32),
            saturated=rows > 0,
            guarded=rows > 0,
            episode=counts,
            control=flatten(state),
            containment=FaultContainment(num_envs, dof, "hold").read(),
            sensors=sensors,
            pushes=dict.fromkeys(COUNTS, counts) if pushes else {},
        )

    def for_envs(self, envs: slice | NDArray[np.intp]) -> EnvStates:
        """Return the state of some envs, as copies."""
        parts: Document = {}
        for name, part in vars(self).items():
            if isinstance(part, dict):
                parts[name] = {leaf: rows[envs].copy() for leaf, rows in part.items()}
            else:
                parts[name] = part[envs].copy()
        return EnvStates(**parts)

    @staticmethod
    def join(parts: Sequence[EnvStates]) -> EnvStates:
        """Return the states of the envs of all ``parts``."""
        if len(parts) == 1:
            return parts[0]
        width = max(part.engine.shape[1] for part in parts)
        tables = []
        for part in parts:
            missing = width - part.engine.shape[1]
            engine = np.pad(part.engine, ((0, 0), (0, missing)), constant_values=np.nan)
            tables.append(replace(part, engine=engine).tables())
        return EnvStates.of(
            {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}
        )

    @staticmethod
    def of(tables: Mapping[str, Rows]) -> EnvStates:
        """Return the states whose arrays have these names, as in :meth:`tables`."""
        parts: Document = {name: {} for name in _TABLES}
        for name, rows in tables.items():
            part, dot, leaf = name.partition(".")
            if dot:
                parts[part][leaf] = rows
            else:
                parts[part] = rows
        return EnvStates(**parts)

    def tables(self) -> dict[str, Rows]:
        """Return all arrays by name, such as "control.age"."""
        tables: dict[str, Rows] = {}
        for name, part in vars(self).items():
            if isinstance(part, dict):
                tables |= {f"{name}.{leaf}": rows for leaf, rows in part.items()}
            else:
                tables[name] = part
        return tables

    def check(self, fresh: EnvStates, command_size: int, engine_sizes: Sequence[int]) -> None:
        """Compare the arrays with :meth:`fresh` states of the runner that restores them.

        ``command_size`` is the size of a setpoint; ``engine_sizes`` (envs,) are the numbers of
        engine values.

        Raises
        ------
        InvalidArgumentError
            An array is missing, unknown, or of another shape, dtype or range.
        """
        sizes = np.array(engine_sizes)[:, None]
        engine = np.zeros((len(sizes), sizes.max()))
        _compare(self.tables(), replace(fresh, engine=engine).tables())
        joint = self.containment["joint"]
        cause = self.containment["cause"]
        of_command = np.isin(cause, [CAUSES.index(name) for name in COMMAND_CAUSES])
        joints = np.where(of_command, command_size, self.effort.shape[1])
        if ((joint < 0) | (joint >= joints) | (cause < 0) | (cause >= len(CAUSES))).any():
            problem = "has a fault of an unknown joint or cause"
            raise InvalidArgumentError("snapshot", problem, remedy="take a new one")
        if not np.isnan(self.engine[np.arange(engine.shape[1]) >= sizes]).all():
            problem = "holds other content than this runner's build makes"
            raise InvalidArgumentError("snapshot", problem, remedy="use the same build=")

    def __repr__(self) -> str:
        return "EnvStates({} envs, {} joints)".format(*self.effort.shape)


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
    states: EnvStates
    actuators: bp.Actuators | None = None
    episodes: NDArray[np.int64] | None = None
    """Stream and episode of each env (envs, 2), from which everything is drawn again; None without
    randomization.
    """
    motion: NDArray[np.float64] | None = None
    """Last joint setpoints and their rates (envs, 2, dof); None where setpoints are not for
    joints.
    """

    def check_options(self, about: Mapping[str, Any]) -> None:
        """Raise InvalidArgumentError if a runner with options ``about`` cannot restore it."""
        different = [key for key, ours in about.items() if self.about.get(key) != ours]
        if different:
            key = different[0]
            ours = about[key]
            theirs = self.about.get(key)
            problem = f"{key} {reprlib.repr(theirs)}, not {reprlib.repr(ours)}"
            if _DIGITS in (len(str(ours)), len(str(theirs))):
                problem = f"another {key}"
            problem = ", and another ".join([problem, *different[1:]])
            remedy = "restore it in a runner made with the same options"
            raise InvalidArgumentError("snapshot", f"is of a runner with {problem}", remedy=remedy)

    def check_tables(self, present: dict[str, Rows]) -> None:
        """Raise InvalidArgumentError if :meth:`tables` have other names, shapes or dtypes than
        those of a runner.
        """
        _compare(self.tables(), present)
        if self.episodes is not None and (self.episodes < 0).any():
            raise InvalidArgumentError(
                "snapshot", "has a negative episode", remedy="take a new one"
            )

    def tables(self) -> dict[str, Rows]:
        """Return episodes and motion by name, where it has them."""
        tables = {"episodes": self.episodes, "motion": self.motion}
        return {name: rows for name, rows in tables.items() if rows is not None}

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
        envs = np.arange(len(self.states.effort))[envs]
        return replace(
            self,
            about=self.about | {"num_envs": len(envs)},
            params=self.params.for_envs(envs),
            states=self.states.for_envs(envs),
            actuators=None if self.actuators is None else self.actuators.for_envs(envs),
            episodes=None if self.episodes is None else self.episodes[envs],
            motion=None if self.motion is None else self.motion[envs],
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
        tables: Document = {"head": np.array(json.dumps(head))} | self.tables()
        tables |= self.states.tables()
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
    def _read(cls, tables: dict[str, Rows]) -> Snapshot:
        """Return the snapshot in the arrays of a file."""
        head = json.loads(str(tables.pop("head")))
        if head["format"] != _FORMAT:
            raise ValueError(f"format {head['format']}, not {_FORMAT}")
        about: Document = dict(head["about"])
        steps = integer("steps", head["steps"], 0, 2**62)
        params, _ = bp.loads_params(head["params"], about["joints"])
        actuators = None
        if "actuators" in head:
            actuators, _ = bp.motors.loads_actuators(head["actuators"], about["joints"])
        rest = {name: tables.pop(name, None) for name in ("episodes", "motion")}
        return cls(about, steps, params, EnvStates.of(tables), actuators, **rest)

    def __repr__(self) -> str:
        about = self.about
        return (
            f"Snapshot({about.get('robot')}, {about.get('num_envs')} envs, control"
            f" {about.get('control')!r}, after {self.steps} sim steps)"
        )


def _compare(theirs: dict[str, Rows], ours: dict[str, Rows]) -> None:
    """Raise InvalidArgumentError if the arrays of a snapshot differ in name, shape or dtype from
    those of a runner.
    """
    kinds, expected = (
        {name: f"{rows.dtype.str} {rows.shape}" for name, rows in tables.items()}
        for tables in (theirs, ours)
    )
    for name in kinds.keys() | expected.keys():
        kind = kinds.get(name)
        other = expected.get(name)
        if kind != other:
            problem = f"has {kind} for {name}, not {other}"
            raise InvalidArgumentError("snapshot", problem, remedy="take a new one")


def initial_actuators(
    actuators: bp.Actuators | None, num_envs: int, dof: int, timestep: float
) -> dict[str, Rows]:
    """Return a state of ``actuators`` by name, in its shapes for ``num_envs`` envs and ``dof``
    joints.
    """
    if actuators is None or not (actuators.measures or actuators.delivers):
        return {}
    longest = bp.Actuators(
        *(None if leaf is None else leaf.max(0, keepdims=True) for leaf in actuators)
    )
    state = bp.motors.init(longest, np.zeros((1, dof)), timestep).leaves()
    return {
        name: np.broadcast_to(leaf, (num_envs, *leaf.shape[1:])) for name, leaf in state.items()
    }
