"""Atomic writes of files, and trials of whether a file can be written."""

from __future__ import annotations

import errno
import os
import secrets
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

TRIAL_BYTES = 4096
"""Size of the file that :func:`try_writing` writes: a block of most file systems [B]."""


def read_bytes(path: str) -> bytes:
    """Return the content of the file at ``path``, in one call of Python; Path.read_bytes takes several."""
    with open(path, "rb", buffering=0) as file:
        return file.read()


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


def try_writing(path: str | os.PathLike[str]) -> None:
    """Raise OSError unless a file can be written at ``path``, whose folder need not exist; leave nothing behind.

    The trial is a small file in the same folder, or in the nearest folder above that exists. Raises OSError if the
    folder cannot be written to, the disk is full, or ``path`` is not a regular file or may not be changed.
    """
    path = Path(os.path.realpath(path))
    try:
        kept = os.stat(path)
    except FileNotFoundError:
        pass
    else:
        if not stat.S_ISREG(kept.st_mode):
            number = errno.EISDIR if stat.S_ISDIR(kept.st_mode) else errno.EINVAL
            raise OSError(number, os.strerror(number), str(path))
        if not os.access(path, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
    folder = path.parent
    while not folder.exists():
        folder = folder.parent
    trial = _temporary(folder / path.name)
    try:
        with trial.open("xb") as file:
            file.write(bytes(TRIAL_BYTES))
    finally:
        trial.unlink(missing_ok=True)


def _temporary(path: Path) -> Path:
    """Return the path of a new hidden file in the same folder, with the same suffix."""
    return path.with_name(f".{secrets.token_hex(8)}{path.suffix}")
