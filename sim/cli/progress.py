"""Bars of progress on stderr."""

from __future__ import annotations

import sys
import weakref
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from threading import Event, Thread
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tqdm import tqdm

AT_MOST = "{desc}: {n_fmt} of at most {total_fmt} evaluations, {elapsed}, at most {remaining} more{postfix}"
"""Format of a bar for work that usually ends long before the last step."""
_bars: weakref.WeakSet[tqdm[Any]] = weakref.WeakSet()


def bar(label: str, **options: Any) -> Callable[[Iterable[Any]], Iterable[Any]]:
    """Return a function that wraps an iterable with a bar on stderr, shown after 1 s; ``options`` go to tqdm.

    In a file there is no bar.
    """
    from tqdm import tqdm

    options = {"delay": 1.0} | options | {"leave": False, "dynamic_ncols": True, "disable": not sys.stderr.isatty()}

    def wrap(items: Iterable[Any]) -> Iterable[Any]:
        shown = tqdm(items, desc=label, **options)
        _bars.add(shown)
        return shown

    return wrap


@contextmanager
def waiting(label: str, **options: Any) -> Iterator[None]:
    """Show ``label`` and the time since on stderr, from 1 s on, while the block runs; ``options`` go to tqdm."""
    ended = Event()

    def show() -> None:
        for _ in bar(label, bar_format="{desc}: {elapsed}", **options)(iter(partial(ended.wait, 0.5), True)):
            pass

    thread = Thread(target=show, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def close_bars() -> None:
    """Remove all bars, so that a message gets a separate line; an error may have left some."""
    for each in list(_bars):
        each.close()
