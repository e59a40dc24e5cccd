"""Imports of packages that are loaded when they are needed."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from signal import SIGINT
from types import MappingProxyType
from typing import Any


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Hold SIGINT back while packages are imported; its handler is called at the end of the block.

    Some packages take every exception in an import of theirs for the lack of an optional package,
    KeyboardInterrupt included: Ctrl-C would be lost, and the package would stay half of itself.
    """
    is_main = threading.current_thread() is threading.main_thread()
    # Without a handler of Python there is no KeyboardInterrupt.
    if not is_main or signal.getsignal(SIGINT) is None:
        yield
        return
    held = list[int]()
    handler = signal.signal(SIGINT, lambda number, _: held.append(number))
    try:
        yield
    finally:
        signal.signal(SIGINT, handler)
        if held:
            signal.raise_signal(SIGINT)


def imported(name: str) -> Any:
    """Return a module, imported at its first use with SIGINT held back.

    Raises
    ------
    ImportError
        It is missing.
    """
    if name in sys.modules:
        return import_module(name)
    with uninterrupted():
        return import_module(name)


def attributes_of(
    package: str, modules: Sequence[str], places: Mapping[str, str] = MappingProxyType({})
) -> Callable[[str], Any]:
    """Return the function ``__getattr__`` of a package that imports its public ``modules``, and the
    modules that define the names in ``places``, when they are used.
    """

    def get(name: str) -> Any:
        if name in places:
            return getattr(imported(places[name]), name)
        problem = f"module {package!r} has no attribute {name!r}"
        if name not in modules:
            raise AttributeError(problem)
        try:
            return imported(f"{package}.{name}")
        except ImportError as error:  # help() goes on without it
            raise AttributeError(f"{problem}: {error}") from error

    return get
