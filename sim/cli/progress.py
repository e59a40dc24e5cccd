"""The bar of commands that take longer than a second."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from typing import Any

DELAY = 1.0
"""Seconds before a bar shows: shorter runs need none."""


def bar(label: str, **options: Any) -> Callable[[Iterable[Any]], Iterable[Any]]:
    """Return a wrapper for an iterable that shows a bar on stderr once the loop has taken a second.

    ``options`` go to :class:`tqdm.tqdm`.
    """
    from tqdm import tqdm

    # A log keeps every state of the bar: a few will do there.
    pace = 0.1 if sys.stderr.isatty() else 5.0

    def wrap(items: Iterable[Any]) -> Iterable[Any]:
        return tqdm(items, desc=label, delay=DELAY, mininterval=pace, leave=False, dynamic_ncols=True, **options)

    return wrap
