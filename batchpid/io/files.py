"""Files: atomic writes, .npz files that may be made to do harm, descriptors."""

from __future__ import annotations

import io
import math
import os
import secrets
import zipfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import BinaryIO

import numpy as np

from batchpid.arrays.array_types import Rows


@contextmanager
def standard_streams_occupied() -> Iterator[None]:
    """Give files that are opened inside a number above 2.

    The numbers 0 to 2 belong to the standard streams. In a program that has closed these, the next file would get such
    a number, and printed text would go into it.
    """
    with ExitStack() as files:
        number = 0
        while number <= 2:
            number = os.open(os.devnull, os.O_RDWR | os.O_CLOEXEC)
            files.callback(os.close, number)
        yield


@contextmanager
def replacing(path: str | os.PathLike[str], overwrite: bool = True) -> Iterator[Path]:
    """Yield a path to write a file to, which then replaces the file at ``path``.

    It is in the same folder and has the same suffix. After an exception, a crash or a kill the older file is unchanged;
    a link stays a link. The caller's file is on the disk before it takes its place. Without ``overwrite`` a file that
    exists by then stays. Raises OSError if the file cannot be written, FileExistsError for a file that stays.
    """
    path = Path(os.path.realpath(path))
    temporary = _temporary(path)
    try:
        yield temporary
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        if overwrite:
            temporary.replace(path)
        else:
            os.link(temporary, path)  # fails where a file exists by now
    except OSError as error:
        if error.errno is None or error.filename not in (None, str(temporary)):
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error  # named as the caller named it
    finally:
        temporary.unlink(missing_ok=True)


def write_atomically(
    path: str | os.PathLike[str], content: str | bytes | Callable[[BinaryIO], object], overwrite: bool = True
) -> None:
    """Write the file at ``path`` as a whole or not at all, as :func:`replacing` does.

    Parameters
    ----------
    content
        Text (UTF-8), bytes, or a function that writes to a binary file, as in
        ``write_atomically(path, lambda file: np.savez(file, **arrays))``.

    Raises
    ------
    OSError
        The file cannot be written, or exists and ``overwrite`` is False.
    """
    with replacing(path, overwrite) as temporary, temporary.open("x+b") as file:
        if callable(content):
            content(file)
        else:
            file.write(content.encode() if isinstance(content, str) else content)


def _temporary(path: Path) -> Path:
    """Return the path of a new hidden file in the same folder, with the same suffix."""
    return path.with_name(f".{secrets.token_hex(8)}{path.suffix}")


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
