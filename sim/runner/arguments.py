"""Arguments of a runner's methods, checked and copied: commands of ticks, and states to reset
to.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

import batchpid as bp
from batchpid.arrays.array_types import Bool, Float64
from batchpid.checks import array, at_least, entries, read_array, within
from batchpid.errors import InvalidArgumentError
from batchpid.sim.engine.native import FARTHEST
from batchpid.sim.engine.protocol import BASE_AT_REST
from batchpid.sim.options.options import RunnerOptions
from batchpid.sim.robot.robot_model import base_start
from batchpid.sim.signals import POSE_UNITS, TWIST_UNITS
from batchpid.stages.values import Command

if TYPE_CHECKING:
    from batchpid.sim.runner.operations import Motion, RunnerState

_SHORTEST = 1e-9
"""Smallest length of a quaternion: a shorter one has large rounding errors."""


def read_command(
    options: RunnerOptions,
    state: RunnerState,
    inputs: Mapping[str, ArrayLike | None],
    seconds: float,
    ticks: int | None = None,
) -> Command:
    """Return the command (ticks, envs, ...) of one tick, or of ``ticks``, of ``seconds`` each, as a
    copy.

    ``inputs`` are its arrays by the names of their arguments, in the order of :class:`Command`.
    Positions of followers are computed from their leaders; the loop passes efforts on to the
    leaders.
    """
    _, rate, acceleration, _ = inputs.values()
    if acceleration is not None:
        _check_acceleration(state.params, inputs)
    table = (options.num_envs,) if ticks is None else (ticks, options.num_envs)
    finite = options.on_invalid_input == "raise"
    rows = list[Any]()
    for (name, value), (kind, names) in zip(inputs.items(), options.command_columns, strict=True):
        # The setpoint, which is first, must be given.
        if value is None and rows:
            rows.append(None)
            continue
        entries: Any = value
        if ticks is not None:
            entries = read_array(name, entries)
            # Rows for all envs.
            entries = entries[:, None] if entries.ndim == 2 else entries
        entries = array(
            name,
            entries,
            (*table, len(names)),
            names,
            finite=finite,
            kind=kind,
        ).copy()
        rows.append(entries[None] if ticks is None else entries)
    if options.sets_positions:
        coupling = options.robot.coupling
        rows[0] = coupling.positions(rows[0])
        rows[1:3] = [None if table is None else coupling.rates(table) for table in rows[1:3]]
    command = Command(*rows)
    if rate is None or state.motion is None or state.params.gain_units is None:
        return command
    return accelerated(command, state.motion, seconds)


def refuse_latency(latency: ArrayLike) -> None:
    """Raise InvalidArgumentError for a latency of setpoints that no plan executes."""
    if not (isinstance(latency, float | int) and latency == 0):
        raise InvalidArgumentError(
            "latency", "has no effect without a plan", remedy="make the Runner with plan="
        )


def read_chunks(
    options: RunnerOptions,
    inputs: Mapping[str, ArrayLike | None],
    latency: ArrayLike,
    ticks: int | None = None,
) -> tuple[Float64, Float64]:
    """Return the chunks (ticks, envs, rows, dof) of one tick, or of ``ticks``, and their latency
    (ticks, envs) [s], as copies.

    A setpoint without an axis of rows is a chunk of one row.

    Raises InvalidArgumentError for more rows than the horizon of the plan, a negative latency, or
    rates beside the setpoints.
    """
    assert options.plan is not None
    (name, value), *rates = inputs.items()
    for rate, table in rates[:2]:
        if table is not None:
            problem = "has no effect with a plan, which makes the rates"
            raise InvalidArgumentError(rate, problem, remedy="leave it out")
    joints = options.robot.joint_names
    rows = read_array(name, cast(ArrayLike, value))
    # One row for all envs, one for each, or several for each.
    axes = rows.ndim - (ticks is not None)
    while 0 < axes < 3:
        rows, axes = rows[..., None, :], axes + 1
    if rows.ndim and rows.shape[-3] not in (1, options.num_envs):
        problem = f"is for {rows.shape[-3]} envs, and there are {options.num_envs}"
        raise InvalidArgumentError(name, problem, remedy="chunks are (envs, rows, dof)")
    count = rows.shape[-2] if rows.ndim else 1
    if count > options.plan.horizon:
        problem = f"has {count} rows, and the plan a horizon of {options.plan.horizon}"
        raise InvalidArgumentError(name, problem, remedy="make a plan of a longer horizon")
    table = (ticks or 1, options.num_envs)
    finite = options.on_invalid_input == "raise"
    chunks = array(name, rows, (*table, count, len(joints)), joints, finite=finite)
    envs = tuple([f"env {env}" for env in range(options.num_envs)])
    ages = array(
        "latency",
        latency,
        table,
        envs,
        finite=False,
        kind="entry",
    )
    at_least(
        "latency",
        ages,
        0.0,
        envs,
        infinite=True,
        kind="entry",
    )
    return options.robot.coupling.positions(chunks).copy(), ages.copy()


def accelerated(command: Command, motion: Motion, seconds: float) -> Command:
    """Return ``command`` (ticks, envs, ...) with the mean accelerations in ticks of ``seconds``
    with rates.

    The mean is the change of the rate over the tick, from ``motion`` before the first. It is taken
    where setpoints change by the mean of the old and the new rate, as they do if rates are those at
    the tick's end. Elsewhere (setpoints that change by the new rate, as increments do) the
    acceleration of the command is kept, or 0.
    """
    setpoint, rate, acceleration, _ = command
    position, velocity = motion
    if velocity is None:
        velocity = np.zeros_like(rate[0])
    # Rates that are not finite become faults.
    with np.errstate(invalid="ignore"):
        moved = np.diff(setpoint, axis=0, prepend=position[None])
        change = np.diff(rate, axis=0, prepend=velocity[None])
        # 0 for increments, else minus half the change.
        ahead = moved - seconds * rate
        fits = np.abs(ahead + 0.5 * seconds * change) < 4 * np.abs(ahead)
        if acceleration is None:
            acceleration = 0.0
        else:
            # With the jerk (acceleration - mean) / (seconds / 2), where the rate is at its largest,
            # too.
            end = seconds**2 * acceleration
            fits |= np.abs(ahead + end / 6 + seconds * change / 3) < np.abs(end) / 24
    mean = np.where(fits, change / seconds, acceleration)
    return command._replace(setpoint_acceleration=mean)


def count_ticks(options: RunnerOptions, setpoints: ArrayLike) -> int:
    """Return the number of ticks of a rollout, from the shape of its setpoints."""
    rows = read_array("setpoints", setpoints)
    num_envs = options.num_envs
    size = options.command.size
    axes = (2, 3) if options.plan is None else (2, 3, 4)
    if rows.ndim not in axes or len(rows) == 0:
        raise InvalidArgumentError(
            "setpoints",
            f"must have shape (ticks, {num_envs}, {size}) or (ticks, {size})",
            value=rows.shape,
            remedy=f"repeat a constant setpoint with np.broadcast_to(setpoint, (ticks, {size}))",
        )
    return len(rows)


def _check_acceleration(params: bp.PIDParams, inputs: Mapping[str, ArrayLike | None]) -> None:
    """Raise InvalidArgumentError for an acceleration that the law does not take."""
    _, rate, acceleration, _ = inputs
    if params.gain_units is None:
        problem = "needs gains in accelerations, but these are in efforts"
        remedy = "give M(q) times it as feedforward, or use robot.designed()"
        raise InvalidArgumentError(acceleration, problem, remedy=remedy)
    if inputs[rate] is None:
        problem, remedy = f"is given without {rate}", f"give {rate}, too"
        raise InvalidArgumentError(acceleration, problem, remedy=remedy)


def joint_rows(options: RunnerOptions, name: str, value: ArrayLike) -> Float64:
    """Return positions or velocities (envs, dof) to reset to."""
    robot = options.robot
    rows = array(name, value, (options.num_envs, robot.dof), robot.joint_names).copy()
    return within(name, rows, FARTHEST, robot.joint_names)


def base_rows(
    options: RunnerOptions,
    inputs: Mapping[str, ArrayLike | None],
    qpos: NDArray[np.float64],
    mask: Bool,
) -> Float64 | None:
    """Return poses and twists (envs, 13) of floating bases to reset to, at joint positions
    ``qpos``.

    ``inputs`` are ``base_pose`` and ``base_twist``, or None. By default a base is at rest at
    :func:`batchpid.sim.robot.robot_model.base_start`.
    """
    robot = options.robot
    if robot.fixed_base:
        for name, value in inputs.items():
            if value is not None:
                problem = "is for a floating base, and this one is fixed"
                remedy = "leave it out, or load the robot with fixed_base=False"
                raise InvalidArgumentError(name, problem, remedy=remedy)
        return None
    rows = np.tile(BASE_AT_REST, (options.num_envs, 1))
    pose = rows[:, :7]
    parts = (pose, POSE_UNITS), (rows[:, 7:], TWIST_UNITS)
    for (name, value), (part, units) in zip(inputs.items(), parts, strict=True):
        if value is None:
            continue
        columns = tuple(units)
        part[...] = array(name, value, part.shape, columns, kind="entry")
        # As near as positions and velocities of joints.
        near = np.abs(part) <= FARTHEST
        entries(
            name,
            part,
            near,
            f"is beyond +-{FARTHEST:g}",
            columns,
            kind="entry",
        )
    if inputs["base_pose"] is None:
        # An MJCF file may have a ground at another height.
        ground = options.ground and options.mjcf is None
        # Most envs start at the same positions, and a start takes the lowest point of all shapes.
        starts: dict[bytes, Float64] = {}
        for env in np.flatnonzero(mask):
            key = qpos[env].tobytes()
            if key not in starts:
                starts[key] = base_start(robot, qpos[env], ground)
            pose[env] = starts[key]
        return rows
    length = np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)
    remedy = "give (w, x, y, z), (1, 0, 0, 0) upright"
    is_long = length > _SHORTEST
    entries(
        "base_pose",
        length,
        is_long,
        "is too short",
        ("quaternion",),
        kind="entry",
        remedy=remedy,
    )
    pose[:, 3:] /= length
    return rows
