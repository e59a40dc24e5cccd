"""Columns of a log by name, from CSV and HDF5 files."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.errors import InvalidArgumentError
from batchpid.sim.recording.hdf5 import LOG_QUANTITIES as QUANTITIES
from batchpid.sim.recording.hdf5 import read_hdf5
from batchpid.sim.recording.recording_files import RecordingError, load_h5py

MAX_BYTES = 1 << 30
"""Most that the columns of an HDF5 file may take."""


def error(source: str, problem: str, remedy: str, value: Any = None) -> InvalidArgumentError:
    """Return the error of a file."""
    return InvalidArgumentError(source, problem, remedy=remedy, value=value)


def read_csv(path: Path) -> tuple[dict[str, Float64], list[int]]:
    """Return the columns of a CSV file by name, and the line of each row."""
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as bad:
        raise error(str(path), f"is not a text: {bad.reason} at byte {bad.start}", "save it as UTF-8") from None
    rows: list[list[float]] = []
    lines: list[int] = []
    header: list[str] | None = None
    delimiter = ","
    for number, line in enumerate(io.StringIO(text, newline=None), 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        if header is None:
            delimiter = max(",;\t", key=line.count)
            header = [name.strip() for name in next(csv.reader([line], delimiter=delimiter))]
            continue
        cells = line.rstrip("\n").split(delimiter)
        if len(cells) != len(header):
            problem = f"line {number} has {len(cells)} cells, the header {len(header)}"
            raise error(str(path), problem, "complete or remove the line")
        try:
            rows.append([float(cell) for cell in cells])
        except ValueError:  # a cell is empty, or text
            rows.append(_read_row(path, number, header, cells))
        lines.append(number)
    if header is None or not rows:
        raise error(str(path), "has no rows", "give a header and one row per sample")
    if len(set(header)) != len(header):
        twice = next(name for name in header if header.count(name) > 1)
        raise error(str(path), f"has the column {twice!r} twice", "keep one of them")
    table = np.array(rows)
    return {name: table[:, index] for index, name in enumerate(header)}, lines


def _read_row(path: Path, number: int, header: list[str], cells: list[str]) -> list[float]:
    """Return the numbers of line ``number``; NaN for empty cells, and for text in columns of other quantities."""
    row = []
    for column, cell in zip(header, cells, strict=True):
        try:
            row.append(float(cell) if cell.strip() else math.nan)
        except ValueError:
            if column.partition(":")[0].strip() in (*QUANTITIES, "time"):
                problem = f"line {number}, column {column!r} is not a number"
                raise error(str(path), problem, "write numbers with a decimal point", cell.strip()) from None
            row.append(math.nan)
    return row


def read_hdf5_columns(path: Path) -> dict[str, Float64] | None:
    """Return the datasets of an HDF5 file by name, None if none is named as a column of a log."""
    load_h5py()  # raises without the package
    try:
        arrays, _ = read_hdf5(path, None, 1, MAX_BYTES)
    except (OSError, ValueError) as bad:
        raise RecordingError(f"{path}: cannot be read as a log: {bad}") from bad
    if not any(name.partition(":")[0].strip() == "qpos" for name in arrays):
        return None
    columns = {}
    for name, array in arrays.items():
        if name.strip() in columns:
            raise error(str(path), f"has the column {name.strip()!r} twice, apart from blanks", "keep one of them")
        if array.ndim > 1 or not len(array):
            problem = f"has {name!r} of shape {array.shape}, which is not a column"
            raise error(str(path), problem, "give each dataset one number per row")
        columns[name.strip()] = array.astype(np.float64)
    return columns
