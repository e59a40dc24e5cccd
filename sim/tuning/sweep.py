"""Sweeps: one robot under many sets of parameters, in parts, recorded in one file that survives a kill.

A part is the rollout of a runner of some of the envs, and a recording in the folder NAME.h5.parts until all are done.
Each is written as a whole or not at all, so that a kill loses one part. The runner has the numbers of its envs
(``first_env``), so the result is bit-identical to a runner of all envs, whatever the size of the parts.
"""

from __future__ import annotations

import json
import os
import shutil
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

import batchpid as bp
from batchpid.arrays.array_types import Document, Rows
from batchpid.arrays.digest import digest
from batchpid.checks.validate import array, check_keywords, file_path, integer, read_array
from batchpid.checks.warn import warn
from batchpid.errors import InvalidArgumentError
from batchpid.io.versions import package_versions
from batchpid.sim.loop.faults import FaultWarning
from batchpid.sim.observation import Observation, Rollout
from batchpid.sim.options import RunnerOptions
from batchpid.sim.recording.recording_files import HDF5, load_h5py, read_recording, write_recording
from batchpid.sim.robot.robot import Robot
from batchpid.sim.robot.run_checks import SetpointCheck, SetpointWarning
from batchpid.sim.runner import Runner
from batchpid.sim.runner_keywords import OPTIONS, checked_option
from batchpid.sim.tuning.history import REMEDY, other_inputs
from batchpid.sim.workers.contact_log import MissedContactWarning

PER_ENV = ("params", "qpos", "qvel", "seed", "actuators", "guard")
"""Arguments with one row, or one row per env."""
_COMMAND = ("setpoints", "setpoint_rates", "setpoint_accelerations", "feedforwards")


def sweep(
    robot: Robot,
    num_envs: int,
    setpoints: ArrayLike,
    path: str | os.PathLike[str],
    *,
    params: bp.PIDParams | Callable[[NDArray[np.int64]], bp.PIDParams] | None = None,
    qpos: ArrayLike | Callable[[NDArray[np.int64]], ArrayLike] | None = None,
    qvel: ArrayLike | Callable[[NDArray[np.int64]], ArrayLike] | None = None,
    seed: int | ArrayLike | None = None,
    setpoint_rates: ArrayLike | None = None,
    setpoint_accelerations: ArrayLike | None = None,
    feedforwards: ArrayLike | None = None,
    part: int = 128,
    progress: Callable[[Sequence[Any]], Iterable[Any]] | None = None,
    **options: Any,
) -> Rollout:
    """Run one robot under ``num_envs`` sets of parameters, each in an env, and record all in the file ``path``.

    The result is that of ``runner = Runner(robot, num_envs, params=params, **options)``, ``runner.reset(qpos, qvel,
    seed=seed)`` and ``runner.rollout(setpoints, ...)``, bit by bit. After a kill the same call continues where the last
    one stopped. Once all is done it reads the file.

    Parameters
    ----------
    setpoints, setpoint_rates, setpoint_accelerations, feedforwards
        Commands (ticks, dof) for all envs, or (ticks, envs, dof), as for :meth:`batchpid.sim.Runner.rollout`.
    path
        Recording to write, .h5, for :func:`batchpid.sim.read_recording`. It holds the inputs as ``info.sweep``.
    params, qpos, qvel
        Parameters, and start [rad or m, and per second]: one row, or one row per env, or a function from the numbers of
        the envs (envs,) to such rows. So are the options ``actuators`` and ``guard``.
    seed
        Streams of a randomization, as for :meth:`batchpid.sim.Runner.reset`; default 0.
    part
        Number of envs that run at once. The result does not depend on it, nor on ``workers`` and ``cluster``.
    progress
        Wraps the list of parts, e.g. ``tqdm.tqdm``.
    options
        More options of :class:`batchpid.sim.Runner`.

    Raises
    ------
    InvalidArgumentError
        An argument is out of range; or there is a file of another sweep, and the message names the inputs that differ.
    RecordingError
        The file cannot be written, or a part of it is damaged.
    MissingDependencyError
        h5py is not installed.
    """
    path, part = file_path("path", path, HDF5), integer("part", part, 1, 1_000_000)
    load_h5py()  # raises without it, before anything runs
    num_envs = checked_option("num_envs", num_envs)
    first = checked_option("first_env", options.get("first_env", 0))
    numbers = first + np.arange(num_envs)
    given: Document = {"params": params, "qpos": qpos, "qvel": qvel, "seed": seed, **options}
    given |= {name: given[name](numbers) for name in PER_ENV if callable(given.get(name))}
    start, streams = [given.pop(name) for name in ("qpos", "qvel")], given.pop("seed")
    check_keywords("Runner", given, OPTIONS)
    checked = RunnerOptions(robot, num_envs, **given)
    is_finite, shape = checked.on_invalid_input == "raise", (num_envs, robot.dof)
    if start[0] is None:
        start[0] = robot.start
    start = [
        array(name, 0.0 if rows is None else rows, shape, robot.joint_names, finite=is_finite)
        for name, rows in zip(("qpos", "qvel"), start, strict=True)
    ]
    if checked.randomization is not None and np.ndim(streams) == 0:
        streams = numbers + integer("seed", streams or 0, 0, 2**62)
    moves = (setpoints, setpoint_rates, setpoint_accelerations, feedforwards)
    command = {name: _ticks(name, rows, num_envs) for name, rows in zip(_COMMAND, moves, strict=True)}
    jax = ("jax",) if checked.backend == "jax" else ()
    inputs = {
        **checked.describe(),
        **{name: getattr(checked, name) for name in ("substeps", "on_invalid_input")},
        **{name: digest(rows) for name, rows in command.items()},
        **{
            name: digest(rows)
            for name, rows in zip(PER_ENV, (checked.params, *start, streams, checked.actuators), strict=False)
        },
        "versions": package_versions(("batchpid", checked.engine, "numpy", *jax)),
    }
    inputs = json.loads(json.dumps(inputs))
    folder = path.with_name(f"{path.name}.parts")
    if path.exists():
        whole = _read(path, inputs)
        shutil.rmtree(folder, ignore_errors=True)  # a kill may have come before it was removed
        return whole
    limits = SetpointCheck(robot)
    limits.check("qpos", robot.coupled(start[0]))
    if checked.sets_positions and checked.guard is None:
        rows = read_array("setpoints", setpoints)
        rows = array("setpoints", rows, (*rows.shape[:-1], robot.dof), robot.joint_names, finite=is_finite)
        limits.check("setpoint", robot.coupled(rows))
    done = {int(each.stem): _read(each, inputs) for each in folder.glob("*.h5") if each.stem.isdecimal()}
    for envs in (progress or iter)(spans := _spans(num_envs, part, done)):
        if envs.start not in done:
            own = {name: _rows(given[name], envs) for name in PER_ENV[4:] if name in given}
            known = given | own | {"params": _rows(checked.params, envs), "first_env": first + envs.start}
            with warnings.catch_warnings(), Runner(robot, envs.stop - envs.start, **known) as runner:
                for kind in (FaultWarning, MissedContactWarning, SetpointWarning):  # they count from the part's first
                    warnings.simplefilter("ignore", kind)
                runner.reset(*(rows[envs] for rows in start), seed=_rows(streams, envs))
                rollout = runner.rollout(**{name: _rows(rows, envs, 1) for name, rows in command.items()})
            _warn(FaultWarning, runner.faults, envs)
            _warn(MissedContactWarning, runner.missed_contacts, envs)
            done[envs.start] = replace(rollout, info=replace(rollout.info, sweep=inputs))
            write_recording(done[envs.start], folder / f"{envs.start}.h5", overwrite=True)
    whole = _joined([done[envs.start] for envs in spans], checked.params, checked.actuators)
    write_recording(whole, path)
    shutil.rmtree(folder, ignore_errors=True)
    return whole


def _warn(kind: type[Warning], events: Sequence[Any], envs: slice) -> None:
    """Warn of the first of some envs' faults or contacts."""
    if events:
        first = events[0]._replace(env=envs.start + events[0].env)
        text = f"{len(events)} in envs {envs.start} to {envs.stop - 1}, the first: {first}"
        warn(text, kind)


def _ticks(name: str, value: ArrayLike | None, num_envs: int) -> Rows | None:
    """Return a command (ticks, envs, size), or (ticks, 1, size) for all envs."""
    if value is None:
        return None
    rows = read_array(name, value)
    rows = rows[:, None] if rows.ndim == 2 else rows
    if rows.ndim != 3 or rows.shape[1] not in (1, num_envs):
        remedy = f"pass (ticks, size), or (ticks, {num_envs}, size)"
        raise InvalidArgumentError(name, f"has shape {np.shape(value)}", remedy=remedy)
    return rows


def _rows(value: Any, envs: slice, axis: int = 0) -> Any:
    """Return the rows of some envs; those of all envs, and what has none, as it is."""
    if hasattr(value, "for_envs"):
        return value.for_envs(envs)
    shared = not isinstance(value, np.ndarray) or value.shape[axis] == 1
    return value if shared else value[(slice(None),) * axis + (envs,)]


def _spans(num_envs: int, part: int, done: Mapping[int, Rollout]) -> list[slice]:
    """Return the envs of each part: those that are ``done``, by their first env, and ``part`` envs between them."""
    spans, first = list[slice](), 0
    while first < num_envs:
        next_done = min([num_envs, *(each for each in done if each > first)])
        spans.append(slice(first, first + done[first].num_envs if first in done else min(first + part, next_done)))
        first = spans[-1].stop
    return spans


def _read(path: Path, inputs: Mapping[str, Any]) -> Rollout:
    """Return a recording of the sweep with these inputs."""
    rollout = read_recording(path)
    theirs = rollout.info.sweep
    problem = "is no sweep" if theirs is None else other_inputs("sweep", theirs, inputs)
    if problem is not None:
        raise InvalidArgumentError("path", problem, value=str(path), remedy=REMEDY)
    return rollout


def _joined(parts: Sequence[Rollout], params: bp.PIDParams, actuators: bp.Actuators | None) -> Rollout:
    """Return the rollouts of successive envs as one."""
    first, infos = parts[0], [each.info for each in parts]
    offsets = np.cumsum([0, *(each.num_envs for each in parts)]).tolist()

    def events(name: str) -> tuple[Any, ...]:
        pairs = zip(offsets, infos, strict=False)
        every = [each._replace(env=offset + each.env) for offset, info in pairs for each in getattr(info, name)]
        return tuple(sorted(every, key=lambda each: (each.time, each.env)))

    whole: Document = {"params": params, "actuators": actuators}
    whole |= {name: events(name) for name in ("faults", "redraws")}
    whole["start"] = np.concatenate([info.start for info in infos if info.start is not None])
    if infos[0].draws is not None:
        whole["episodes"] = np.concatenate([info.episodes for info in infos if info.episodes is not None])
        whole["draws"] = {name: np.concatenate([(info.draws or {})[name] for info in infos]) for name in infos[0].draws}
    seen = zip(*(each.observation for each in parts), strict=True)
    observation = Observation._make([None if each[0] is None else np.concatenate(each, 1) for each in seen])
    setpoint = np.concatenate([each.setpoint for each in parts], 1)
    return Rollout(first.time, setpoint, observation, first.tick, replace(first.info, **whole))
