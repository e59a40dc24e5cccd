"""CSV files of setpoints: the motion of ``batchpid excite``, and what ``batchpid rollout
--trajectory`` follows.

A file has a header and one row per tick, in SI units, with the columns in any order::

    time, setpoint:JOINT ..., optionally setpoint_rate:JOINT ..., optionally
    setpoint_acceleration:JOINT ...

A row holds at its time, the end of a tick. A first row at time 0 is the pose in which the robot
starts. Followers need no column: the values of their leaders determine theirs. Commas, tabs or
semicolons separate the cells, as in a log (:mod:`batchpid.sim.identification.log_files`), which is read
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
from batchpid.checks import choice, file_path
from batchpid.errors import InvalidArgumentError
from batchpid.sim.robot.robot import Robot
from batchpid.trajectories import Trajectory

SETPOINT_QUANTITIES = ("setpoint", "setpoint_rate", "setpoint_acceleration")
TIME_TOLERANCE = 0.2
"""Largest error of a time, over the time step: times of files are rounded."""
LONGEST_ROW_TIME = 1.0
"""Longest time from row to row [s]."""


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


def error(
    source: str,
    problem: str,
    remedy: str,
    value: object = None,
) -> InvalidArgumentError:
    """Return the error of a file."""
    return InvalidArgumentError(source, problem, remedy=remedy, value=value)


def read_csv(
    path: Path, quantities: Sequence[str] = SETPOINT_QUANTITIES
) -> tuple[dict[str, Float64], list[int]]:
    """Return the columns of a CSV file by name, and the line of each row.

    Empty cells are NaN, and so is text in columns of other quantities than ``quantities`` and the
    time.
    """
    source = str(path)
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as bad:
        problem = f"is not text: {bad.reason} at byte {bad.start}"
        raise error(source, problem, "save it as UTF-8") from None
    lines = [
        (number, line)
        for number, line in enumerate(text.splitlines(), 1)
        if line.partition("#")[0].strip()
    ]
    rows = list[list[float]]()
    header = list[str]()
    if lines:
        # Programs separate cells by other characters, and quote the names.
        delimiter = max(",;\t", key=re.sub('"[^"]*"', "", lines[0][1]).count)
        try:
            # Line by line: a quotation mark that is not closed ends with its line.
            names, *table = [
                next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))
                for _, line in lines
            ]
        except csv.Error as bad:
            raise error(source, str(bad), "correct the line") from None
        header = [re.sub(r"\s*:\s*", ":", name.strip(), count=1) for name in names]
        numbers = [number for number, _ in lines[1:]]
        for number, cells in zip(numbers, table, strict=False):
            if len(cells) != len(header):
                problem = f"line {number} has {len(cells)} cells, the header {len(header)}"
                raise error(source, problem, "complete or remove the line")
            try:
                rows.append([float(cell) for cell in cells])
            except ValueError:  # a cell is empty, or text
                place = f"line {number}, column"
                named = zip(header, cells, strict=True)
                rows.append(
                    [_number(source, place, name, cell, quantities) for name, cell in named]
                )
    if not rows:
        raise error(source, "has no rows", "give a header and one row per sample")
    columns = dict(zip(header, np.array(rows).T, strict=False))
    if len(columns) < len(header):
        raise error(source, "has two columns with the same name", "rename one of them")
    return columns, numbers


def _number(
    source: str,
    place: str,
    column: str,
    cell: str,
    quantities: Sequence[str],
) -> float:
    """Return the number in a cell; NaN for an empty one, and for text in a column of another
    quantity.
    """
    try:
        return float(cell.strip() or "nan")
    except ValueError:
        if column.partition(":")[0] not in (*quantities, "time"):
            return math.nan
    remedy = "give the number alone, in SI units, with a decimal point"
    raise error(source, f"{place} {column!r} is not a number", remedy, cell)


def columns_by_joint(
    robot: Robot,
    source: str,
    columns: dict[str, Float64],
    quantities: Sequence[str],
) -> dict[str, dict[str, Float64]]:
    """Return the columns of ``quantities`` by quantity and by the robot's name of their joint;
    others are left out.

    Raises InvalidArgumentError for an unknown joint.
    """
    tables: dict[str, dict[str, Float64]] = {quantity: {} for quantity in quantities}
    for name, values in columns.items():
        quantity, colon, joint = name.partition(":")
        if colon and quantity in tables:
            choice(f"{source}: column {name!r}: joint", joint, robot.joint_names)
            tables[quantity][joint] = values
    return tables


def setpoint_csv(robot: Robot, motion: Trajectory) -> str:
    """Return setpoints and rates of ``motion`` as CSV; its first row is for time 0, the others for
    the ends of ticks.

    A log may keep the columns of the rates: ``batchpid identify`` ignores them.
    """
    names = [
        f"{quantity}:{name}" for quantity in SETPOINT_QUANTITIES[:2] for name in robot.joint_names
    ]
    rows = np.column_stack([motion.time - motion.time[0], motion.position, motion.velocity])
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerow(["time", *names])
    np.savetxt(text, rows, "%.9g", ",")
    return text.getvalue()


def read_setpoints(robot: Robot, path: str | os.PathLike[str], timestep: float | None) -> Setpoints:
    """Return the setpoints in a file, for sim steps of ``timestep`` [s]; with None, rows may be at
    any distance, one each "sim step".

    Rates that the file does not give are central differences, the short way round on continuous
    joints. Without a row at time 0, the robot's start pose is the row before the first.

    Raises
    ------
    InvalidArgumentError
        The rows are not equally spaced by whole sim steps, a column is unknown or missing, or a
        number is not finite; the message names the file, and line or column.
    FileNotFoundError
        There is no such file.
    """
    path = file_path("trajectory", path, (".csv", ".txt"))
    source = str(path)
    columns, lines = read_csv(path)
    tables = _tables(robot, source, columns, lines)
    tables["setpoint"] = robot.coupling.positions(tables["setpoint"])
    times = columns["time"]
    if timestep is None:
        timestep = float(times[-1] - times[0]) / (len(times) - 1) if len(times) > 1 else times[0]
    substeps, at_zero = _substeps(source, times, lines, timestep)
    start = None
    if at_zero:
        start = tables["setpoint"][0]
        tables = {quantity: rows[1:] for quantity, rows in tables.items()}
    if "setpoint_rate" not in tables:
        first = robot.start if start is None else start
        rows = np.vstack([first, tables["setpoint"]])
        rows[:, robot.continuous] = np.unwrap(rows[:, robot.continuous], axis=0)
        tables["setpoint_rate"] = np.gradient(rows, substeps * timestep, axis=0)[1:]
    return Setpoints(
        start,
        tables["setpoint"],
        tables["setpoint_rate"],
        tables.get("setpoint_acceleration"),
        substeps,
    )


def _tables(
    robot: Robot,
    source: str,
    columns: dict[str, Float64],
    lines: list[int],
) -> dict[str, Float64]:
    """Return a finite table (rows, dof) for each quantity of the file; followers without column
    have 0.
    """
    names = (
        f"columns are time, {', '.join(f'{quantity}:JOINT' for quantity in SETPOINT_QUANTITIES)}"
    )
    if "time" not in columns:
        raise error(source, "has no column 'time', in seconds", names)
    for name, values in columns.items():
        if name != "time" and name.partition(":")[0] not in SETPOINT_QUANTITIES:
            raise error(source, f"has the unknown column {name!r}", f"remove it; {names}")
        finite = np.isfinite(values)
        if not finite.all():
            problem = f"line {lines[finite.argmin()]}, column {name!r} is empty or not finite"
            raise error(source, problem, "give the number")
    tables = {}
    for quantity, by_joint in columns_by_joint(robot, source, columns, SETPOINT_QUANTITIES).items():
        if quantity != "setpoint" and not by_joint:
            continue
        tables[quantity] = np.zeros((len(lines), robot.dof))
        for column, joint in enumerate(robot.joint_names):
            if joint in by_joint:
                tables[quantity][:, column] = by_joint[joint]
            elif robot.independent[column]:
                remedy = "give every joint but followers"
                raise error(f"{source}: column {quantity}:{joint}", "is missing", remedy)
    return tables


def _substeps(
    source: str,
    time: Float64,
    lines: list[int],
    timestep: float,
) -> tuple[int, bool]:
    """Return the sim steps from row to row, and whether the first row is for time 0.

    Raises InvalidArgumentError for other times than 0, if it is there, and the ends of all ticks.
    """
    # The median, since a row may be missing. Times of files are rounded.
    period = float(np.median(np.diff(time) if len(time) > 1 else time))
    if abs(period) > LONGEST_ROW_TIME:
        remedy = f"give one every {LONGEST_ROW_TIME:g} s at least; time is in seconds"
        raise error(source, f"has rows every {period:g} s", remedy)
    substeps = max(1, round(period / timestep))
    dt = substeps * timestep
    first = int(time[0] > 0.5 * dt)
    expected = dt * np.arange(first, first + len(time))
    late = np.abs(time - expected) > TIME_TOLERANCE * timestep
    if late.any():
        row = int(late.argmax())
        problem = f"line {lines[row]}: time is {time[row]:.9g} s, and not {expected[row]:.9g} s"
        remedy = f"begin at 0 or {dt:g} s, with rows whole sim steps of {timestep:g} s apart"
        # Rows of 30 Hz are no whole number of the default steps.
        if abs(period - dt) > 1e-6 * timestep:
            if len(time) > 1 and period > 0:
                # Times are rounded: over all rows the period is closer than between two.
                period = (time[-1] - time[0]) / np.round(np.diff(time) / period).sum()
            remedy += f", or use --timestep {period / substeps:.9g} (timestep=)"
        raise error(source, problem, remedy)
    if first + len(time) == 1:
        problem = f"line {lines[0]}: the only row is at 0 s"
        raise error(source, problem, "give a row for the end of each tick")
    return substeps, first == 0
