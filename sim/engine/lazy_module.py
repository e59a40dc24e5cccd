"""Packages that are imported at the first use of a name in them."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any


class LazyModule(ModuleType):
    """Module that is imported at the first use of a name in it."""

    def __getattr__(self, name: str) -> Any:
        if sys.modules.get(self.__name__) is self:  # within the block
            del sys.modules[self.__name__]
        return getattr(importlib.import_module(self.__name__), name)


@contextmanager
def imported_lazily(name: str) -> Iterator[None]:
    """Give a :class:`LazyModule` to modules that import the package ``name`` within the block."""
    if name in sys.modules:
        yield
        return
    sys.modules[name] = lazy = LazyModule(name)
    try:
        yield
    finally:
        if sys.modules.get(name) is lazy:
            del sys.modules[name]
