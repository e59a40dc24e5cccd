"""Checks of keyword arguments: an unknown one is an error that names the nearest known one."""

from __future__ import annotations

import difflib
import functools
import inspect
from collections.abc import Callable, Collection
from typing import Any, Concatenate, ParamSpec, TypeVar

from batchpid.errors import InvalidArgumentError

P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T")


def check_keywords(owner: str, given: Collection[str], known: Collection[str]) -> None:
    """Raise InvalidArgumentError for the first name in ``given`` that is not among the ``known`` ones of ``owner``."""
    for name in given:
        if name not in known:
            near = difflib.get_close_matches(name, known, 1)
            remedy = f"did you mean {near[0]!r}?" if near else f"use one of {', '.join(known)}"
            raise InvalidArgumentError(name, f"is not an argument of {owner}", remedy=remedy)


def known_keywords(function: Callable[P, R]) -> Callable[P, R]:
    """Decorate ``function``, which is called with the ``**options`` of others, to check the names of its keywords."""
    known = tuple(inspect.signature(function).parameters)

    @functools.wraps(function)
    def checked(*args: P.args, **options: P.kwargs) -> R:
        check_keywords(function.__name__, options, known)
        return function(*args, **options)

    return checked


def checks_keywords(owner: str) -> Callable[[type[T]], type[T]]:
    """Decorate a class to check the names of its keywords; errors say that they are not arguments of ``owner``."""

    def decorate(record: type[T]) -> type[T]:
        init: Any = record.__init__
        known = tuple(inspect.signature(record).parameters)

        @functools.wraps(init)
        def checked(self: T, *args: Any, **options: Any) -> None:
            check_keywords(owner, options, known)
            init(self, *args, **options)

        record.__init__ = checked  # type: ignore[method-assign, assignment]
        return record

    return decorate


def arguments_of(record: Callable[P, object]) -> Callable[[Callable[..., None]], Callable[Concatenate[Any, P], None]]:
    """Decorate an ``__init__`` that passes its arguments on to ``record``, for editors to show those of ``record``."""
    return lambda init: init
