"""Warnings at the line of the caller's own program, however deep in batchpid they arise."""

from __future__ import annotations

import sys
import warnings
from types import FrameType

_INSIDE = ("batchpid.", "importlib.")


def warn(message: str, category: type[Warning]) -> None:
    """Issue a warning at the first line on the stack that is not in batchpid, nor in the machinery
    of imports.
    """
    frame = sys._getframe(1)
    while frame.f_back is not None and _is_inside(frame):
        frame = frame.f_back
    place = frame.f_globals
    warnings.warn_explicit(
        message,
        category,
        frame.f_code.co_filename,
        frame.f_lineno,
        place.get("__name__", "sys"),
        place.setdefault("__warningregistry__", {}),
    )


def _is_inside(frame: FrameType) -> bool:
    return f"{frame.f_globals.get('__name__', '')}.".startswith(_INSIDE)
