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
_DECIMAL_COMMA = re.compile(r"[+-]?[\d.]*,\d+([eE][+-]?\d+)?")


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
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as bad:
        raise error(
            str(path), f"is not a text: {bad.reason} at byte {bad.start}", "save it as UTF-8"
        ) from None
    numbered = [(number, line) for number, line in enumerate(text.splitlines(), 1) if line.strip()]
    numbered = [(number, line) for number, line in numbered if not line.lstrip().startswith("#")]
    if len(numbered) < 2:
        raise error(str(path), "has no rows", "give a header and one row per sample")
    delimiter = max(",;\t", key=re.sub(r'"[^"]*"', "", numbered[0][1]).count)
    quote = "'" if "'" in numbered[0][1] else '"'
    header, rows = list[str](), list[list[float]]()
    for number, line in numbered:
        try:
            (cells,) = csv.reader(
                [line], delimiter=delimiter, quotechar=quote, skipinitialspace=True, strict=True
            )
        except csv.Error:
            problem = f"line {number} has a quote that does not enclose a whole cell"
            raise error(
                str(path), problem, f"put {quote} at both ends of a cell, or at none"
            ) from None
        if not header:
            header = [name.strip() for name in cells]
            continue
        if len(cells) != len(header):
            problem = f"line {number} has {len(cells)} cells, the header {len(header)}"
            raise error(str(path), problem, "complete or remove the line")
        try:
            rows.append([float(cell) for cell in cells])
        except ValueError:  # a cell is empty, or text
            rows.append(_numbers(path, number, header, cells, quantities))
    if twice := [name for name in header if header.count(name) > 1]:
        raise error(str(path), f"has the column {twice[0]!r} twice", "keep one of them")
    return dict(zip(header, np.array(rows).T, strict=True)), [number for number, _ in numbered[1:]]


def _numbers(
    path: Path, number: int, header: list[str], cells: list[str], quantities: Sequence[str]
) -> list[float]:
    """Return the numbers of line ``number``; NaN for empty cells, and for text in columns of other
    quantities.
    """
    row = []
    for column, cell in zip(header, map(str.strip, cells), strict=True):
        try:
            row.append(float(cell) if cell else math.nan)
        except ValueError:
            if column.partition(":")[0].strip() in (*quantities, "time"):
                remedy = "give the number alone, in SI units, or remove the row"
                if _DECIMAL_COMMA.fullmatch(cell):
                    remedy = "write numbers with a decimal point"
                raise error(
                    str(path), f"line {number}, column {column!r} is not a number", remedy, cell
                ) from None
            row.append(math.nan)
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
    by: dict[str, dict[str, Float64]] = {quantity: {} for quantity in quantities}
    for name, values in columns.items():
        quantity, colon, joint = name.partition(":")
        quantity, joint = quantity.strip(), joint.strip().removeprefix(prefix)
        if not colon or quantity not in by:
            continue
        choice(f"{source}: column {name!r}: joint", joint, robot.joint_names)
        if joint in by[quantity]:
            raise error(
                source,
                f"has the column '{quantity}:{joint}' twice, apart from blanks",
                "keep one of them",
            )
        by[quantity][joint] = values
    return by


def setpoint_csv(robot: Robot, motion: Trajectory) -> str:
    """Return setpoints and rates of ``motion`` as CSV; its first row is for time 0, the others for
    the ends of ticks.

    A log may keep the columns of the rates: ``batchpid identify`` ignores them.
    """
    names = [f"{quantity}:{name}" for quantity in QUANTITIES[:2] for name in robot.joint_names]
    lines = [",".join(["time", *names])]
    dt = float(motion.time[0])
    for time, row in zip(
        motion.time - dt, np.hstack([motion.position, motion.velocity]), strict=True
    ):
        lines.append(",".join([f"{time:.9g}", *(f"{value:.9g}" for value in row)]))
    return "\n".join(lines) + "\n"


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
    if not path.exists():
        raise FileNotFoundError(2, "there is no such file", str(path))
    source = str(path)
    columns, lines = read_csv(path, QUANTITIES)
    tables = _tables(robot, source, columns, lines)
    position = robot.coupled(tables["setpoint"])
    _check_limits(robot, source, position, lines)
    substeps, at_zero = _substeps(source, columns["time"], lines, timestep)
    start, first = (position[0], 1) if at_zero else (robot.start, 0)
    position = position[first:]
    rate, acceleration = (
        None if each is None else each[first:] for each in map(tables.get, QUANTITIES[1:])
    )
    steps, has_rates = 0, rate is not None
    if rate is None:
        rate, steps = _rates(robot, np.vstack([start, position]), substeps * timestep)
    return Setpoints(
        start if at_zero else None, position, rate, acceleration, substeps, has_rates, steps
    )


def _rates(robot: Robot, position: Float64, dt: float) -> tuple[Float64, int]:
    """Return the rates (ticks, dof) at the ends of ticks of ``dt`` [s] between rows (ticks + 1,
    dof), and the steps.

    A rate is the mean of the changes before and after, or the change before the last row or a step;
    0 in a step.
    """
    change = wrap(np.diff(position, axis=0), np.where(robot.continuous, 1 / TURN, 0.0), np) / dt
    is_step = np.abs(change) > STEP * robot.velocity_limit
    following = np.concatenate([change[1:], change[-1:]])
    following = np.where(np.concatenate([is_step[1:], is_step[-1:]]), change, following)
    return np.where(is_step, 0.0, 0.5 * (change + following)), int(
        is_step[:, robot.independent].sum()
    )


def _tables(
    robot: Robot, source: str, columns: dict[str, Float64], lines: list[int]
) -> dict[str, Float64]:
    """Return a finite table (rows, dof) for each quantity of the file; followers without column
    have 0.
    """
    known = f"time, {', '.join(f'{quantity}:JOINT' for quantity in QUANTITIES)}"
    if "time" not in columns:
        problem = f"has no column 'time', but {', '.join(list(columns)[:6])}"
        raise error(source, problem, f"begin the header with time, in seconds; columns are {known}")
    for name, values in columns.items():
        quantity, colon, _ = name.partition(":")
        if name != "time" and not (colon and quantity.strip() in QUANTITIES):
            raise error(
                source, f"has the unknown column {name!r}", f"remove it; columns are {known}"
            )
        if not np.isfinite(values).all():
            line = lines[int(np.argmin(np.isfinite(values)))]
            raise error(
                source, f"line {line}, column {name!r} is empty or not finite", "give the number"
            )
    by = columns_by_joint(robot, source, columns, QUANTITIES)
    found = {quantity: of_joints for quantity, of_joints in by.items() if of_joints}
    needed = ("setpoint", *(["setpoint_rate"] if "setpoint_acceleration" in found else []))
    leaders = [
        name for name, free in zip(robot.joint_names, robot.independent, strict=True) if free
    ]
    tables = {}
    for quantity in dict.fromkeys((*needed, *found)):
        for joint in leaders:
            if joint not in found.get(quantity, {}):
                remedy = "give every joint that does not follow another one"
                remedy += "" if quantity == "setpoint" else f", or no {quantity} at all"
                if quantity == "setpoint_rate" and quantity not in found:
                    remedy = "accelerations need the rates beside them"
                raise error(f"{source}: column {quantity}:{joint}", "is missing", remedy)
        none = np.zeros(len(lines))
        tables[quantity] = np.stack(
            [found[quantity].get(name, none) for name in robot.joint_names], axis=1
        )
    return tables


def _check_limits(robot: Robot, source: str, position: Float64, lines: list[int]) -> None:
    """Raise InvalidArgumentError for a position (rows, dof) outside the limits of its joint."""
    outside = (position < robot.lower - LIMIT_TOLERANCE) | (
        position > robot.upper + LIMIT_TOLERANCE
    )
    outside &= robot.independent
    if not outside.any():
        return
    row, joint = (int(index) for index in np.argwhere(outside)[0])
    problem = (
        f"line {lines[row]}, column 'setpoint:{robot.joint_names[joint]}' is outside the joint's"
        " limits"
    )
    remedy = f"keep it within {robot.lower[joint]:g} to {robot.upper[joint]:g} {robot.units[joint]}"
    raise error(source, problem, remedy, float(position[row, joint]))


def _substeps(source: str, time: Float64, lines: list[int], timestep: float) -> tuple[int, bool]:
    """Return the sim steps from row to row, and whether the first row is for time 0.

    Raises InvalidArgumentError for other times than 0, if it is there, and the ends of all ticks.
    """
    steps = np.diff(time)
    if (steps <= 0).any():
        line = lines[int(np.argmax(steps <= 0)) + 1]
        raise error(
            source, f"line {line}: time does not increase", "sort the rows, and give each time once"
        )
    tolerance = SHARE * timestep
    if len(time) == 1 and time[0] <= tolerance:
        remedy = "add a row for the end of each tick"
        raise error(source, f"line {lines[0]}: the only row is at {time[0]:g} s", remedy)
    period = float(np.median(steps)) if len(steps) else float(time[0])
    if len(steps) and abs(np.mean(steps) - period) < 0.01 * period:  # no row is missing
        period = float(np.mean(steps))
    if period > LONGEST:
        raise error(
            source,
            f"has rows every {period:g} s",
            f"give one every {LONGEST:g} s at least; time is in seconds",
        )
    substeps = max(1, round(period / timestep))
    if abs(period - substeps * timestep) > tolerance:
        problem = f"has rows every {period:g} s, and sim steps take {timestep:g} s"
        raise error(
            source,
            problem,
            f"rows must be whole sim steps apart: use --timestep {period / substeps:.9g}",
        )
    dt = substeps * timestep
    at_zero = abs(time[0]) <= tolerance
    if not at_zero and abs(time[0] - dt) > tolerance:
        remedy = (
            f"begin at 0, with the pose in which the robot starts, or at {dt:g}, the end of the"
            " first tick"
        )
        raise error(source, f"line {lines[0]}: the first row is at {time[0]:.9g} s", remedy)
    expected = dt * np.arange(1 - at_zero, len(time) + 1 - at_zero)
    late = np.abs(time - expected) > tolerance
    if late.any():
        row = int(np.argmax(late))
        problem = f"line {lines[row]}: time is {time[row]:.9g} s, and not {expected[row]:.9g} s"
        raise error(
            source,
            problem,
            f"give rows that are equally spaced, here by {dt:g} s: resample the file",
        )
    return substeps, at_zero
