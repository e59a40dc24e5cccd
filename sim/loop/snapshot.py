"""Snapshots: the state of all envs, physics and controller, as arrays.

A snapshot is a barrier. The engine has more state than positions and velocities: contact caches, warm starts, and the
order in which it solves contacts. All of these depend on the past, and can be neither read nor written. So everyone who
continues from a snapshot, in the process that took it or in another, does so with a new world in that state, and the
results are bit-identical. The barrier itself changes the last bits.
"""

from __future__ import annotations

import json
import os
import reprlib
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid.arrays.array_types import Document, Rows
from batchpid.arrays.choices import CHOICES, Everywhere
from batchpid.arrays.trees import flatten, unflatten
from batchpid.checks.validate import file_path, integer, names
from batchpid.errors import InvalidArgumentError
from batchpid.io.files import read_npz, write_atomically
from batchpid.motors.friction import FrictionState
from batchpid.motors.guard import GuardState
from batchpid.sim.loop.faults import CAUSES, COMMAND_CAUSES, ORIGIN, FaultContainment
from batchpid.sim.loop.pushes import COUNTS
from batchpid.sim.observation import observed_by_loop, untouched
from batchpid.sim.runner_keywords import OPTIONS, RunnerKeywords

EPISODE = "episode"
"""Name of the resets of each env with actuators (envs,)."""
CHANGED = "changed"
"""Name of the setpoints that the guard changed in the last sim step."""
AGE = "age"
"""Name of the sim steps since the friction model of an env took its inertia (envs,)."""
_FORMAT = 12
_AT_ORIGIN, _WITH_ISOLATION = 11, 10
"""Earlier formats: robots began at the origin; the state of a robot in SAPIEN had one more value, after 2 dof + 13."""
_DIGITS = 64
"""Length of a digest."""
_ACTUATORS = "actuator_params"
_CHOICES: dict[str, tuple[Any, ...]] = {name: tuple(named.values()) for name, named in CHOICES.items()}
_CHOICES["conditional"] = (Everywhere(),)
"""Params that hold no numbers, by name, with their values."""


@dataclass(frozen=True, eq=False)
class EnvStates:
    """State of some envs; every array has a row for each."""

    engine: NDArray[np.float64]
    """Robots and content (envs, values), of which only the engine knows the meaning; NaN where an env has fewer values
    than another (:meth:`batchpid.sim.engine.protocol.EnginePack.read_state`)."""
    effort: NDArray[np.float32]
    saturated: NDArray[np.bool_]
    controller: dict[str, Rows]
    """Leaves of :class:`batchpid.PIDState`."""
    friction: dict[str, Rows]
    """Leaves of :class:`batchpid.motors.friction.FrictionState`, and :data:`AGE`; none without Coulomb friction."""
    actuators: dict[str, Rows]
    """Leaves of :class:`batchpid.motors.ActuatorState`, and :data:`EPISODE`; none without effects on
    efforts or measurements."""
    guard: dict[str, Rows]
    """Leaves of :class:`batchpid.motors.guard.GuardState`, and :data:`CHANGED`; none without guard."""
    containment: dict[str, Rows]
    """See :class:`batchpid.sim.loop.faults.FaultContainment`."""
    sensors: dict[str, Rows]
    """Quantities of :class:`batchpid.sim.Observation` from the sensors of links; none without such sensors."""
    pushes: dict[str, NDArray[np.int64]]
    """Counts of :class:`batchpid.sim.loop.pushes.Pushes`; none without pushes."""

    def for_envs(self, envs: slice) -> EnvStates:
        """Return the state of some envs, as copies."""
        tables = flatten(vars(self), ".")
        return EnvStates(**unflatten(vars(self), {name: rows[envs].copy() for name, rows in tables.items()}, "."))

    @staticmethod
    def join(parts: Sequence[EnvStates]) -> EnvStates:
        """Return the states of the envs of all ``parts``."""
        width = max(part.engine.shape[1] for part in parts)
        missing = [((0, 0), (0, width - part.engine.shape[1])) for part in parts]
        wide = [np.pad(part.engine, each, constant_values=np.nan) for part, each in zip(parts, missing, strict=True)]
        tables = [flatten(vars(part) | {"engine": rows}, ".") for part, rows in zip(parts, wide, strict=True)]
        joined = {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}
        return EnvStates(**unflatten(vars(parts[0]), joined, "."))

    def check(
        self,
        num_envs: int,
        dof: int,
        controller: dict[str, Rows],
        friction: bool,
        actuators: dict[str, Rows],
        guard: bool,
        engine_sizes: Sequence[int],
        command_size: int,
        sensors: dict[str, Rows],
        pushes: bool,
    ) -> None:
        """Check the states' envs and joints, and the number of engine values of each env, ``engine_sizes`` (envs,).

        ``controller`` is a state of the control, ``actuators`` one of the actuators; ``friction`` tells whether joints
        have Coulomb friction, ``guard`` whether there is a guard. ``command_size`` is the size of a setpoint,
        ``sensors`` are quantities of links, ``pushes`` tells whether bases are pushed.

        Raises
        ------
        InvalidArgumentError
            An array is missing, unknown, or of another shape, dtype or range.
        """
        table, double, row = np.zeros((num_envs, dof), np.float32), np.zeros((num_envs, dof)), np.zeros(num_envs, bool)
        expected = EnvStates(
            engine=np.zeros((num_envs, self.engine.size // num_envs)),
            effort=table,
            saturated=table > 0,
            controller=controller,
            friction={**dict.fromkeys(FrictionState._fields, double), AGE: row.astype(np.int64)} if friction else {},
            actuators=actuators,
            guard={**dict.fromkeys(GuardState._fields, double), CHANGED: table > 0} if guard else {},
            containment=FaultContainment(num_envs, dof, "hold").read(),
            sensors=sensors,
            pushes=dict.fromkeys(COUNTS, row.astype(np.int64)) if pushes else {},
        )
        ours, theirs = (flatten(vars(each), ".") for each in (expected, self))
        for name in sorted(ours | theirs):
            if name not in theirs:
                problem = f"no {name}"
            elif name not in ours:
                problem = f"an unknown {name}"
            elif theirs[name].shape != ours[name].shape or theirs[name].dtype != ours[name].dtype:
                kinds = [f"{rows.dtype} {rows.shape}" for rows in (theirs[name], ours[name])]
                problem = f"{name} of {kinds[0]}, not {kinds[1]}"
            else:
                continue
            raise InvalidArgumentError("snapshot", f"has {problem}", remedy="take a new one")
        joint, cause = self.containment["joint"], self.containment["cause"]
        of_command = np.isin(cause, [CAUSES.index(name) for name in COMMAND_CAUSES])
        for name, rows, counts in (
            ("cause", cause, np.full(num_envs, len(CAUSES))),
            ("joint", joint, np.where(of_command, command_size, dof)),
        ):
            if (bad := (rows < 0) | (rows >= counts)).any():
                problem = f"names a {name} beyond {counts[bad][0]}"
                raise InvalidArgumentError("snapshot", problem, remedy="take a new one")
        for env, size in enumerate(engine_sizes):
            if size > self.engine.shape[1] or not np.isnan(self.engine[env, size:]).all():
                raise InvalidArgumentError(
                    "snapshot",
                    "holds other content than this runner's build makes",
                    env=env,
                    remedy="make the runner with the same build=",
                )

    def __repr__(self) -> str:
        return "EnvStates({} envs, {} joints)".format(*self.effort.shape)


@dataclass(frozen=True, eq=False)
class Snapshot:
    """State of all envs of a runner at one moment. It can be pickled, or kept in a file: :meth:`save`, :meth:`load`."""

    about: Document
    """Options that a runner must share to restore it: :meth:`batchpid.sim.RunnerOptions.describe`."""
    steps: int
    """Sim steps up to this moment."""
    params: bp.PIDParams
    states: EnvStates
    actuators: bp.Actuators | None = None
    episodes: NDArray[np.int64] | None = None
    """Stream and episode of each env (envs, 2), from which everything is drawn again; None without randomization."""
    motion: NDArray[np.float64] | None = None
    """Last joint setpoints and their rates (2, envs, dof); None where setpoints are not for joints."""

    def check(self, about: Mapping[str, Any]) -> None:
        """Check that a runner with options ``about`` can restore it.

        Raises
        ------
        InvalidArgumentError
            It cannot.
        """
        different = [key for key, ours in about.items() if self.about.get(key) != ours]
        if different:
            key, *others = different
            ours, theirs = about[key], self.about.get(key)
            is_digest = any(isinstance(each, str) and len(each) == _DIGITS for each in (ours, theirs))
            problem = f"another {key}" if is_digest else f"{key} {reprlib.repr(theirs)}, not {ours!r}"
            problem += "".join(f", and another {other}" for other in others)
            remedy = "restore it in a runner made with the same options"
            raise InvalidArgumentError("snapshot", f"is of a runner with {problem}", remedy=remedy)

    def for_envs(self, envs: slice) -> Snapshot:
        """Return the snapshot of some envs."""
        actuators = None if self.actuators is None else self.actuators.for_envs(envs)
        episodes = None if self.episodes is None else self.episodes[envs]
        params, states = self.params.for_envs(envs), self.states.for_envs(envs)
        return replace(self, params=params, states=states, actuators=actuators, episodes=episodes)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write an .npz file, as a whole or not at all: an older file stays until this one is complete.

        Raises
        ------
        OSError
            The file cannot be written.
        """
        leaves = {name: leaf for name, leaf in self.params._asdict().items() if leaf is not None}
        choices = {name: type(leaf).__name__ for name, leaf in leaves.items() if isinstance(leaf, tuple)}
        arrays = {name: leaf for name, leaf in leaves.items() if name not in choices}
        head = {"format": _FORMAT, "about": self.about, "steps": self.steps, "markers": choices}
        tables: Document = {
            "head": np.array(json.dumps(head)),
            **flatten({"params": arrays, _ACTUATORS: _options(self.actuators), **vars(self.states)}, "."),
        }
        for name in ("episodes", "motion"):
            if (rows := getattr(self, name)) is not None:
                tables[name] = rows
        write_atomically(file_path("path", path), lambda file: np.savez(file, **tables))

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Snapshot:
        """Read a file of :meth:`save`. Nothing in it is executed, and it takes memory in proportion to its size.

        Raises
        ------
        InvalidArgumentError
            The file is missing, damaged, or no snapshot of this version.
        """
        path = file_path("path", path)
        try:
            if not path.is_file():
                raise ValueError("there is no such file")
            return cls._read(read_npz(path, max_bytes=path.stat().st_size))
        except Exception as error:  # a damaged file can make the libraries raise anything
            raise InvalidArgumentError(
                "path",
                f"cannot be read as a snapshot: {error or type(error).__name__}",
                value=str(path),
                remedy="pass a file that Snapshot.save wrote",
            ) from error

    @classmethod
    def _read(cls, tables: dict[str, Rows]) -> Snapshot:
        """Return the snapshot in the arrays of a file, if they agree with each other."""
        head = json.loads(str(tables.pop("head")))
        if head["format"] not in (_FORMAT, _AT_ORIGIN, _WITH_ISOLATION):
            raise ValueError(f"format {head['format']}, not {_FORMAT}")
        about, steps, choices = head["about"], head["steps"], head["markers"]
        for each in fields(RunnerKeywords):  # written before there was this option, which then had its default
            if each.default is not MISSING and OPTIONS[each.name].kept.get("snapshot") == "":
                about.setdefault(each.name, each.default)
        num_envs = integer("num_envs", about["num_envs"], 1, 2**31)
        dof, steps = len(names("joints", about["joints"])), integer("steps", steps, 0, 2**62)
        if head["format"] == _WITH_ISOLATION and about["engine"] == "sapien":
            tables["engine"] = np.delete(tables["engine"], 2 * dof + 13, axis=1)
        if head["format"] in (_AT_ORIGIN, _WITH_ISOLATION):
            tables["containment.start_base"] = np.tile(ORIGIN, (num_envs, 1))
        episodes = tables.pop("episodes", None)
        if (about.get("randomization") is None) != (episodes is None):
            raise ValueError("its episodes do not fit its randomization")
        if episodes is not None and (
            episodes.shape != (num_envs, 2) or episodes.dtype != np.int64 or (episodes < 0).any()
        ):
            raise ValueError(f"its episodes are not counts (envs, 2) of {num_envs} envs")
        motion = tables.pop("motion", None)
        groups = _groups(tables)
        motors = groups.pop(_ACTUATORS, None)
        motors = {name: leaf if leaf.ndim else leaf.item() for name, leaf in (motors or {}).items()}
        actuators = bp.make_actuators(dof, **motors) if motors else None
        kinds = {name: {type(one).__name__: one for one in _CHOICES[name]} for name in choices}
        chosen = {name: kinds[name][kind] for name, kind in choices.items()}
        params, states = bp.PIDParams(**groups.pop("params"), **chosen), EnvStates(**groups)
        params.options()  # raises for an unknown choice
        params.check(num_envs)
        # Rows first: then the next check allocates no more than the size of the file.
        if states.effort.shape != (num_envs, dof) or params.num_joints != dof or params.dtype.kind != "f":
            raise ValueError(f"its effort {states.effort.shape} or params do not fit {num_envs} envs of {dof} joints")
        controller = states.controller
        if about["control"] in ("pid", "drive", "effort"):
            controller = bp.init(params, np.zeros((num_envs, dof), np.float32)).leaves()
        if any(leaf.shape[:1] != (num_envs,) for leaf in controller.values()):
            raise ValueError(f"the state of its controller is not of {num_envs} envs")
        motors = initial_actuators(actuators, num_envs, dof, about["timestep"])
        if (about.get("randomization") or {}).get("actuators"):
            motors = states.actuators  # the runner that restores it checks them
        links = {name: tuple(about.get(name) or ()) for name in ("contacts", "wrenches")}
        pushes = "push" in (about.get("randomization") or {})
        sensors = untouched(num_envs, observed_by_loop(True, **links))
        size = dof if about.get("command") is None else len(names("command", about["command"]))
        states.check(
            num_envs, dof, controller, bool(states.friction), motors, bool(states.guard), (), size, sensors, pushes
        )
        if motion is not None and (motion.shape != (2, num_envs, dof) or motion.dtype != np.float64):
            raise ValueError(f"its motion is not a setpoint and a rate of {num_envs} envs of {dof} joints")
        return cls(about, steps, params, states, actuators, episodes, motion)

    def __repr__(self) -> str:
        about = self.about
        return (
            f"Snapshot({about.get('robot')}, {about.get('num_envs')} envs, control {about.get('control')!r}, "
            f"after {self.steps} sim steps)"
        )


def initial_actuators(actuators: bp.Actuators | None, num_envs: int, dof: int, timestep: float) -> dict[str, Rows]:
    """Return a state of ``actuators`` by name, in its shapes for ``num_envs`` envs and ``dof`` joints."""
    if actuators is None or not (actuators.measures or actuators.delivers):
        return {}
    longest = bp.Actuators(*(None if leaf is None else leaf.max(0, keepdims=True) for leaf in actuators))
    state = bp.motors.init(longest, np.zeros((1, dof)), timestep).leaves()
    state[EPISODE] = np.zeros(1, np.int64)
    return {name: np.broadcast_to(leaf, (num_envs, *leaf.shape[1:])) for name, leaf in state.items()}


def _options(actuators: bp.Actuators | None) -> dict[str, Rows]:
    """Return the arguments of :func:`batchpid.make_actuators` as arrays."""
    if actuators is None:
        return {}
    return {name: np.asarray(value) for name, value in actuators.options().items() if name != "dtype"}


def _groups(tables: Mapping[str, Rows]) -> Document:
    """Return the arrays of a file by name, and those with a dot in their name in groups; a group may be empty."""
    names = ("controller", "friction", "actuators", "guard", "containment", "sensors", "pushes")
    groups: Document = {name: {} for name in names}
    for name, rows in tables.items():
        group, dot, leaf = name.partition(".")
        if dot:
            groups.setdefault(group, {})[leaf] = rows
        else:
            groups[name] = rows
    return groups
