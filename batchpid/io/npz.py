"""Arrays in .npz files that may be damaged, or made to do harm."""

from __future__ import annotations

import io
import math
import os
import zipfile
from pathlib import Path

import numpy as np

from batchpid.arrays.array_types import Rows

_END_RECORD = 22
"""Bytes of a zip file's last record, without its comment."""


def read_npz(path: str | os.PathLike[str], max_bytes: int) -> dict[str, Rows]:
    """Return all arrays of an .npz file of numbers and texts, by name, each with its checksum (CRC-32) verified.

    Nothing is executed, and nothing is decompressed before it is known to fit.

    Parameters
    ----------
    max_bytes
        Largest size of all arrays together.

    Raises
    ------
    Exception
        The file is not an NPZ file. The libraries raise different types, mostly ValueError or ``zipfile.BadZipFile``.
    """
    tables: dict[str, Rows] = {}
    with Path(path).open("rb") as file, zipfile.ZipFile(file) as archive:
        members = archive.infolist()
        file.seek(-_END_RECORD - len(archive.comment), os.SEEK_END)
        # zipfile does not compare this count: a directory cut at its beginning would go unnoticed.
        if int.from_bytes(file.read(12)[10:], "little") != len(members):
            raise ValueError("its list of arrays is damaged")
        if (total := sum(member.file_size for member in members)) > max_bytes:
            raise ValueError(f"its arrays have {total:,} bytes, more than max_bytes={max_bytes:,}")
        for member in members:
            name = member.filename.removesuffix(".npy")
            if name in tables or member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise ValueError(f"its {name} is there twice, or compressed in an unknown way")
            with archive.open(member) as opened:
                # Not read(), which decompresses all of a member before it looks at its size.
                tables[name] = _array(name, opened.read(member.file_size + 1))
    return tables


def _array(name: str, data: bytes) -> Rows:
    """Return the array in the bytes of an .npy file."""
    file = io.BytesIO(data)
    if np.lib.format.read_magic(file) != (1, 0):
        raise ValueError(f"its {name} is of an unknown format")
    shape, fortran, dtype = np.lib.format.read_array_header_1_0(file)
    if dtype.kind not in "biufU" or not dtype.itemsize:
        raise ValueError(f"its {name} is of {dtype}")
    if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize != len(data) - file.tell():
        raise ValueError(f"its {name} has shape {shape}, which is not what it holds")
    array: Rows = np.ndarray(shape, dtype, data, file.tell(), order="F" if fortran else "C")
    return array.astype(dtype.newbyteorder("="))
