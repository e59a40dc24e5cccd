"""Bars of progress on stderr."""

from __future__ import annotations

import sys
import weakref
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tqdm import tqdm

AT_MOST = "{desc}: {n_fmt} of at most {total_fmt} evaluations, {elapsed}, at most {remaining} more{postfix}"
"""Format of a bar for work that usually ends long before the last step."""
_bars: weakref.WeakSet[tqdm[Any]] = weakref.WeakSet()


def bar(label: str, **options: Any) -> Callable[[Iterable[Any]], Iterable[Any]]:
    """Return a function that wraps an iterable with a bar on stderr, shown after 1 s; ``options`` go to tqdm."""
    from tqdm import tqdm

    # A log file keeps every state of the bar, so it gets few.
    options |= {"delay": 1.0, "mininterval": 0.1 if sys.stderr.isatty() else 5.0, "leave": False, "dynamic_ncols": True}

    def wrap(items: Iterable[Any]) -> Iterable[Any]:
        shown = tqdm(items, desc=label, **options)
        _bars.add(shown)
        return shown

    return wrap


def close_bars() -> None:
    """Remove all bars, so that a message gets a separate line; an error may have left some."""
    for each in list(_bars):
        each.close()
