"""Logs from CSV files, with a column for each quantity and joint, and from runs of a Runner.

Columns are ``time`` [s], ``qpos:JOINT``, and ``setpoint:JOINT``, ``effort:JOINT`` or
``measured_effort:JOINT``, in rad, m, N m or N. ``feedforward:JOINT`` is refused, others are
ignored. Recordings say the meaning of their arrays by themselves.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from batchpid.checks import file_path
from batchpid.sim.identification.log import CommandKind, Log, checked
from batchpid.sim.recording.recording_files import RecordingError, read_recording
from batchpid.sim.recording.setpoint_files import columns_by_joint, error, read_csv
from batchpid.sim.robot.robot import Robot
from batchpid.sim.rollout import PARAMS, RESET, RESTORE, Rollout

LOG_QUANTITIES = ("setpoint", "effort", "feedforward", "measured_effort", "qpos")
HDF5 = (".h5", ".hdf5")
A_LOG = "a log is a .csv file with the columns time, qpos:JOINT and setpoint:JOINT or effort:JOINT"


def read_logs(
    robot: Robot,
    paths: Iterable[str | os.PathLike[str]],
    kind: CommandKind | None = None,
    *,
    hold: bool = False,
) -> list[Log]:
    """Return the logs in files, one for each stretch without gaps in time.

    Parameters
    ----------
    kind
        Command to read where a file has both: "setpoint" or "effort"; default the one that it has,
        else "effort".
    hold
        True if the commands of CSV files hold from row to row, False to interpolate between rows.

    Raises
    ------
    InvalidArgumentError
        A file holds no log of this robot; the message names the file, line and column.
    RecordingError
        A recording cannot be read.
    FileNotFoundError
        There is no such file.
    """
    logs = list[Log]()
    for path in map(Path, paths):
        if path.suffix.lower() in HDF5:
            logs += _recorded(robot, path, kind)
        else:
            logs += checked(robot, _read_table(robot, path, kind, hold))
    return logs


def _recorded(robot: Robot, path: Path, kind: CommandKind | None) -> list[Log]:
    """Return the logs of a recording."""
    try:
        rollout = read_recording(path)
    except RecordingError as bad:
        raise RecordingError(f"{bad}; {A_LOG}, or a recording of a Runner") from bad
    return logs_of_rollout(robot, rollout, kind, source=str(path))


def _read_table(
    robot: Robot,
    path: Path,
    kind: CommandKind | None,
    hold: bool,
) -> Log:
    """Return the log in a CSV file."""
    source = str(file_path("log", path, (".csv", ".txt", *HDF5)))
    columns, lines = read_csv(path, (*LOG_QUANTITIES, "time"))
    by = columns_by_joint(robot, source, columns, LOG_QUANTITIES)
    if by["feedforward"]:
        remedy = "log the complete efforts, without the columns of the feedforward"
        raise error(source, "has a feedforward, which a fit does not simulate", remedy)
    # Measured efforts stand for commands that were not logged.
    effort = "measured_effort" if by["measured_effort"] and not by["effort"] else "effort"
    kind = kind or ("effort" if by[effort] else "setpoint")
    command = effort if kind == "effort" else kind
    logged = by["qpos"] | by[command]
    independent = np.flatnonzero(robot.independent).tolist()
    joints = [joint for joint in independent if robot.joint_names[joint] in logged]
    names = [robot.joint_names[joint] for joint in joints]
    needed = [f"{quantity}:{name}" for quantity in ("qpos", command) for name in names or ["JOINT"]]
    for column in ("time", *needed):
        if column not in columns:
            remedy = f"{A_LOG}; a joint without both rests"
            raise error(f"{source}: column {column}", "is missing", remedy)
    qpos, commands = (
        np.stack([by[quantity][name] for name in names], axis=1) for quantity in ("qpos", command)
    )
    time = columns["time"]
    return Log(
        source,
        tuple(joints),
        kind,
        time,
        qpos,
        time,
        commands,
        held=hold,
        measured=command == "measured_effort",
        lines=np.array(lines),
    )


def logs_of_rollout(
    robot: Robot,
    rollout: Rollout,
    kind: CommandKind | None = None,
    source: str = "rollout",
) -> list[Log]:
    """Return a log for each env of ``rollout`` and each stretch between its resets. Setpoints are
    efforts under control "effort".

    Raises InvalidArgumentError if the simulation of a fit lacks an effect of the run.
    """
    info = rollout.info
    recorded: CommandKind = "effort" if info.control == "effort" else "setpoint"
    follows = recorded == "setpoint"
    lengths = np.abs(np.diff(rollout.time) - rollout.tick)
    # Changes before the first row are before the log.
    within = np.zeros((0, rollout.num_envs), np.uint8)
    if rollout.changes is not None:
        within = rollout.changes[1:]
    obstacles = {
        f"is of the joints {', '.join(info.joint_names)}": info.joint_names != robot.joint_names,
        "was made with a plan": info.plan is not None,
        "was made with setpoints that are not of joints": info.own_command is not None,
        f"was made under control {info.control!r}": info.control not in (None, "pid", "effort"),
        f"holds {recorded}s": kind not in (None, recorded),
        "was made with setpoint rates": info.rates and follows,
        "was made with a feedforward": rollout.feedforward is not None,
        "has setpoints that a guard changed": np.any(rollout.guarded),
        "was made with a randomization": info.randomization,
        "has params that were changed": (within & PARAMS).any() and follows,
        "has a snapshot that was restored": (within & RESTORE).any(),
        "has ticks of varied length": (lengths > 1e-9 + 1e-6 * rollout.tick).any(),
        "has failed": not rollout.ok.all(),
    }
    for problem, holds in obstacles.items():
        if holds:
            remedy = "record another run under control pid or effort"
            raise error(source, f"{problem}, which a fit cannot use", remedy)
    joints = np.flatnonzero(robot.independent)
    logs = []
    for env in range(rollout.num_envs):
        params = None
        if info.params is not None and follows:
            params = info.params.for_envs(slice(env, env + 1))
        log = Log(
            source if rollout.num_envs == 1 else f"{source}, env {env}",
            tuple(joints.tolist()),
            recorded,
            rollout.time,
            rollout.qpos[:, env, joints].astype(float),
            rollout.time - rollout.tick,
            np.asarray(rollout.setpoint)[:, env, joints].astype(float),
            held=True,
            timestep=info.timestep,
            compensate=info.compensate,
            params=params,
        )
        resets = np.flatnonzero(within[:, env] & RESET) + 1
        logs += checked(robot, log, resets.tolist())
    return logs
