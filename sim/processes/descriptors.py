"""The standard streams of a program that may have closed them."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator


@contextlib.contextmanager
def standard_streams_occupied() -> Iterator[None]:
    """Give files that are opened inside a number above 2.

    The numbers 0 to 2 belong to the standard streams. In a program that has closed these, the next file would get such
    a number, and printed text would go into it.
    """
    with contextlib.ExitStack() as files:
        number = 0
        while number <= 2:
            number = os.open(os.devnull, os.O_RDWR | os.O_CLOEXEC)
            files.callback(os.close, number)
        yield


def is_open(descriptor: int) -> bool:
    """Return whether this process has a file open under the number ``descriptor``."""
    try:
        os.fstat(descriptor)
    except OSError:
        return False
    return True
