"""Progress bars of commands that may take longer than a second."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from typing import Any

DELAY = 1.0
"""Time before a bar is shown [s]."""


def bar(label: str, **options: Any) -> Callable[[Iterable[Any]], Iterable[Any]]:
    """Return a function that wraps an iterable with a bar on stderr; ``options`` go to :class:`tqdm.tqdm`."""
    from tqdm import tqdm

    # A log file keeps every state of the bar, so it gets few.
    interval = 0.1 if sys.stderr.isatty() else 5.0

    def wrap(items: Iterable[Any]) -> Iterable[Any]:
        return tqdm(items, desc=label, delay=DELAY, mininterval=interval, leave=False, dynamic_ncols=True, **options)

    return wrap
