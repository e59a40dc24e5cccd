"""CSV files of setpoints: the motion of ``batchpid excite``, and what ``batchpid rollout
--trajectory`` follows.

A file has a header and one row per tick, in SI units, with the columns in any order::

    time, setpoint:JOINT ..., optionally setpoint_rate:JOINT ..., optionally
    setpoint_acceleration:JOINT ...

A row holds at its time, the end of a tick. A first row at time 0 is the pose in which the robot
starts. Followers need no column: the values of their leaders determine theirs. Commas, tabs or
semicolons separate the cells, as in a log (:mod:`batchpid.sim.identification.logs`), which is read
here, too.
"""

from __future__ import annotations

import csv
import io
import math
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.arrays.elementwise import TURN, wrap
from batchpid.checks.validate import choice, file_path
from batchpid.errors import InvalidArgumentError
from batchpid.sim.robot.description import LIMIT_TOLERANCE
from batchpid.sim.robot.robot import Robot
from batchpid.trajectories import Trajectory

QUANTITIES = ("setpoint", "setpoint_rate", "setpoint_acceleration")
SHARE = 0.2
"""Largest error of a time, over the time step: times of files are rounded."""
LONGEST = 1.0
"""Longest time from row to row [s]."""
STEP = 2.0
"""Speed of a setpoint, in velocity limits, above which its change over a tick counts as a step."""


class Setpoints(NamedTuple):
    """Setpoints of a file, with a row for each tick; arrays are (ticks, dof) in rad or m, and per s
    and s^2.
    """

    start: Float64 | None
    """Pose (dof,) of the row at time 0; None without such a row."""
    position: Float64
    rate: Float64
    acceleration: Float64 | None
    """None where the file has no accelerations."""
    substeps: int
    """Sim steps of a tick."""
    has_rates: bool
    """False if the rates are central differences."""
    steps: int
    """Number of changes that count as steps of the setpoint, with rate 0."""


def error(source: str, problem: str, remedy: str, value: object = None) -> InvalidArgumentError:
    """Return the error of a file."""
    return InvalidArgumentError(source, problem, remedy=remedy, value=value)


def read_csv(
    path: Path, quantities: Sequence[str] = QUANTITIES
) -> tuple[dict[str, Float64], list[int]]:
    """Return the columns of a CSV file by name, and the line of each row.

    Empty cells are NaN, and so is text in columns of other quantities than ``quantities`` and the
    time.
    """
    source = str(path)
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as bad:
        problem = f"is not a text: {bad.reason} at byte {bad.start}"
        raise error(source, problem, "save it as UTF-8") from None
    lines = dict(enumerate(text.splitlines(), 1))
    lines = {number: line for number, line in lines.items() if line.partition("#")[0].strip()}
    if len(lines) < 2:
        raise error(source, "has no rows", "give a header and one row per sample")
    first = next(iter(lines.values()))
    delimiter = max(",;\t", key=re.sub(r'"[^"]*"', "", first).count)
    quote = "'" if "'" in first else '"'
    rows = list[list[float]]()
    header = list[str]()
    # Line by line: a quote that is not closed must not swallow the rest of the file.
    for number, line in lines.items():
        try:
            (cells,) = csv.reader(
                [line], delimiter=delimiter, quotechar=quote, skipinitialspace=True, strict=True
            )
        except csv.Error:
            problem = f"line {number} has a quote that does not enclose a whole cell"
            raise error(source, problem, f"put {quote} at both ends, or at none") from None
        if not header:
            header = [name.strip() for name in cells]
            continue
        if len(cells) != len(header):
            problem = f"line {number} has {len(cells)} cells, the header {len(header)}"
            raise error(source, problem, "complete or remove the line")
        try:
            rows.append([float(cell) for cell in cells])
        except ValueError:  # a cell is empty, or text
            rows.append(_numbers(source, number, header, cells, quantities))
    columns = dict(zip(header, np.array(rows).T, strict=False))
    if len(columns) < len(header):
        raise error(source, "has two columns of one name", "give each column another name")
    return columns, [*lines][1:]


def _numbers(
    source: str, line: int, header: list[str], cells: list[str], quantities: Sequence[str]
) -> list[float]:
    """Return the numbers of a line; NaN for empty cells, and for text in columns of other
    quantities.
    """
    row = []
    for column, cell in zip(header, map(str.strip, cells), strict=True):
        try:
            value = float(cell or "nan")
        except ValueError:
            value = math.nan
            if column.partition(":")[0].strip() in (*quantities, "time"):
                remedy = "give the number alone, in SI units, with a decimal point"
                problem = f"line {line}, column {column!r} is not a number"
                raise error(source, problem, remedy, cell) from None
        row.append(value)
    return row


def columns_by_joint(
    robot: Robot,
    source: str,
    columns: dict[str, Float64],
    quantities: Sequence[str],
    prefix: str = "",
) -> dict[str, dict[str, Float64]]:
    """Return the columns of ``quantities`` by quantity and by the robot's name of their joint;
    others are left out.

    Raises InvalidArgumentError for an unknown joint, or for two columns that differ in blanks
    alone.
    """
    tables: dict[str, dict[str, Float64]] = {quantity: {} for quantity in quantities}
    for name, values in columns.items():
        quantity, colon, joint = (part.strip() for part in name.partition(":"))
        if not colon or quantity not in tables:
            continue
        joint = joint.removeprefix(prefix)
        choice(f"{source}: column {name!r}: joint", joint, robot.joint_names)
        if joint in tables[quantity]:
            problem = f"has the column '{quantity}:{joint}' twice, apart from blanks"
            raise error(source, problem, "keep one of them")
        tables[quantity][joint] = values
    return tables


def setpoint_csv(robot: Robot, motion: Trajectory) -> str:
    """Return setpoints and rates of ``motion`` as CSV; its first row is for time 0, the others for
    the ends of ticks.

    A log may keep the columns of the rates: ``batchpid identify`` ignores them.
    """
    names = [f"{quantity}:{name}" for quantity in QUANTITIES[:2] for name in robot.joint_names]
    rows = np.column_stack([motion.time - motion.time[0], motion.position, motion.velocity])
    text = io.StringIO()
    np.savetxt(text, rows, "%.9g", ",", header=",".join(["time", *names]), comments="")
    return text.getvalue()


def read_setpoints(robot: Robot, path: str | os.PathLike[str], timestep: float) -> Setpoints:
    """Return the setpoints in a file, for sim steps of ``timestep`` [s].

    Rates that the file does not give are central differences, the short way round on continuous
    joints, and 0 where the setpoint makes a step. Without a row at time 0, the robot's start pose
    is the row before the first.

    Raises
    ------
    InvalidArgumentError
        The rows are not equally spaced by whole sim steps, a column is unknown or missing, a number
        is not finite, or a position is outside the joint's limits; the message names the file, and
        line or column.
    FileNotFoundError
        There is no such file.
    """
    path = file_path("trajectory", path, (".csv", ".txt"))
    source = str(path)
    columns, lines = read_csv(path, QUANTITIES)
    tables = _tables(robot, source, columns, lines)
    tables["setpoint"] = robot.coupled(tables["setpoint"])
    _check_limits(robot, source, tables["setpoint"], lines)
    substeps, at_zero = _substeps(source, columns["time"], lines, timestep)
    start = robot.start
    if at_zero:
        start = tables["setpoint"][0]
        tables = {quantity: rows[1:] for quantity, rows in tables.items()}
    position, rate, acceleration = map(tables.get, QUANTITIES)
    assert position is not None
    steps = 0
    has_rates = rate is not None
    if rate is None:
        rate, steps = _rates(robot, np.vstack([start, position]), substeps * timestep)
    first = start if at_zero else None
    return Setpoints(first, position, rate, acceleration, substeps, has_rates, steps)


def _rates(robot: Robot, position: Float64, dt: float) -> tuple[Float64, int]:
    """Return the rates (ticks, dof) at the ends of ticks of ``dt`` [s] between rows (ticks + 1,
    dof), and the steps.

    A rate is the mean of the changes before and after, or the change before the last row or a step;
    0 in a step.
    """
    period = np.where(robot.continuous, 1 / TURN, 0.0)
    change = wrap(np.diff(position, axis=0), period, np) / dt
    is_step = np.abs(change) > STEP * robot.velocity_limit
    following = np.concatenate([change[1:], change[-1:]])
    following = np.where(np.concatenate([is_step[1:], is_step[-1:]]), change, following)
    rate = np.where(is_step, 0.0, 0.5 * (change + following))
    return rate, int(is_step[:, robot.independent].sum())


def _tables(
    robot: Robot, source: str, columns: dict[str, Float64], lines: list[int]
) -> dict[str, Float64]:
    """Return a finite table (rows, dof) for each quantity of the file; followers without column
    have 0.
    """
    names = f"columns are time, {', '.join(f'{quantity}:JOINT' for quantity in QUANTITIES)}"
    if "time" not in columns:
        raise error(source, "has no column 'time', in seconds", names)
    for name, values in columns.items():
        if name != "time" and name.partition(":")[0].strip() not in QUANTITIES:
            raise error(source, f"has the unknown column {name!r}", f"remove it; {names}")
        finite = np.isfinite(values)
        if not finite.all():
            problem = f"line {lines[finite.argmin()]}, column {name!r} is empty or not finite"
            raise error(source, problem, "give the number")
    by_quantity = columns_by_joint(robot, source, columns, QUANTITIES)
    if by_quantity["setpoint_acceleration"] and not by_quantity["setpoint_rate"]:
        raise error(source, "has no rates", "accelerations need the rates beside them")
    tables = {}
    for quantity, of_joints in by_quantity.items():
        if quantity != "setpoint" and not of_joints:
            continue
        tables[quantity] = np.zeros((len(lines), robot.dof))
        for column, joint in enumerate(robot.joint_names):
            if joint in of_joints:
                tables[quantity][:, column] = of_joints[joint]
            elif robot.independent[column]:
                remedy = "give every joint that does not follow another one"
                raise error(f"{source}: column {quantity}:{joint}", "is missing", remedy)
    return tables


def _check_limits(robot: Robot, source: str, position: Float64, lines: list[int]) -> None:
    """Raise InvalidArgumentError for a position (rows, dof) outside the limits of its joint."""
    beyond = np.maximum(robot.lower - position, position - robot.upper) > LIMIT_TOLERANCE
    beyond &= robot.independent
    if beyond.any():
        row, joint = np.argwhere(beyond)[0].tolist()
        name = robot.joint_names[joint]
        unit = robot.units[joint]
        problem = f"line {lines[row]}, column 'setpoint:{name}' is outside the joint's limits"
        remedy = f"keep it within {robot.lower[joint]:g} to {robot.upper[joint]:g} {unit}"
        raise error(source, problem, remedy, float(position[row, joint]))


def _substeps(source: str, time: Float64, lines: list[int], timestep: float) -> tuple[int, bool]:
    """Return the sim steps from row to row, and whether the first row is for time 0.

    Raises InvalidArgumentError for other times than 0, if it is there, and the ends of all ticks.
    """
    tolerance = SHARE * timestep
    periods = np.diff(time) if len(time) > 1 else time
    period = float(np.median(periods))
    if abs(np.mean(periods) - period) < 0.01 * period:  # no row is missing
        period = float(np.mean(periods))
    if period <= tolerance:
        if len(time) > 1:
            problem = "time does not increase"
        else:
            problem = f"the only row is at {time[0]:g} s"
        remedy = "give a row for the end of each tick"
        raise error(source, f"line {lines[0]}: {problem}", remedy)
    if period > LONGEST:
        remedy = f"give one every {LONGEST:g} s at least; time is in seconds"
        raise error(source, f"has rows every {period:g} s", remedy)
    substeps = max(1, round(period / timestep))
    dt = substeps * timestep
    if abs(period - dt) > tolerance:
        problem = f"has rows every {period:g} s, and sim steps take {timestep:g} s"
        remedy = f"use --timestep {period / substeps:.9g}, so that rows are whole sim steps apart"
        raise error(source, problem, remedy)
    first = int(time[0] > tolerance)
    expected = dt * np.arange(first, first + len(time))
    late = np.abs(time - expected) > tolerance
    if late[0]:
        remedy = f"begin at 0, the pose of the start, or at {dt:g}, the end of the first tick"
        raise error(source, f"line {lines[0]}: the first row is at {time[0]:.9g} s", remedy)
    if late.any():
        row = int(late.argmax())
        problem = f"line {lines[row]}: time is {time[row]:.9g} s, and not {expected[row]:.9g} s"
        raise error(source, problem, f"resample the file to rows {dt:g} s apart")
    return substeps, first == 0
