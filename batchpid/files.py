"""Atomic writes of files."""

from __future__ import annotations

import os
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a path to write a file to, which then replaces the file at ``path``.

    It is in the same folder and has the same suffix. After an exception, a crash or a kill the older file is unchanged;
    a link stays a link. The caller's file is on the disk before it takes its place.

    Raises
    ------
    OSError
        The file cannot be written.
    """
    path = Path(os.path.realpath(path))
    temporary = path.with_name(f".{secrets.token_hex(8)}{path.suffix}")
    try:
        yield temporary
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_atomically(path: str | os.PathLike[str], content: str | bytes | Callable[[BinaryIO], object]) -> None:
    """Write the file at ``path`` as a whole or not at all, as :func:`replacing` does.

    Parameters
    ----------
    content
        Text (UTF-8), bytes, or a function that writes to a binary file, as in
        ``write_atomically(path, lambda file: np.savez(file, **arrays))``.

    Raises
    ------
    OSError
        The file cannot be written.
    """
    with replacing(path) as temporary, temporary.open("x+b") as file:
        if callable(content):
            content(file)
        else:
            file.write(content.encode() if isinstance(content, str) else content)
