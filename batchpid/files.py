"""Atomic writes of files."""

from __future__ import annotations

import os
import secrets
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO


def write_atomically(path: str | os.PathLike[str], content: str | bytes | Callable[[BinaryIO], object]) -> None:
    """Write the file at ``path`` as a whole or not at all; an existing file is replaced.

    The content goes to a temporary file in the same folder, to the disk, and then takes the place of ``path``: a
    crash or a kill leaves the older file as it was.

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
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        with temporary.open("x+b") as file:
            if callable(content):
                content(file)
            else:
                file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
