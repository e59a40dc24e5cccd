"""Elementwise stages of a sim step as programs of the extension: one call executes all operations of a stage.

The only definition is traced, and results are bit-identical. They are for control steps that are not a program as a
whole: those with a controller of the caller's, or of the backend "jax".
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from batchpid.motors import STAGES, Coefficients, Stages
from batchpid.native.array_program import ArrayProgram
from batchpid.native.availability import obstacle
from batchpid.native.operations import OPERATION
from batchpid.native.tracing import trace

LEAST_OPERATIONS = 3
"""Least number of operations for which a call of the extension is faster than NumPy."""


def compiled_stages(k: Coefficients, shape: tuple[int, int]) -> Stages:
    """Return the stages of actuators with coefficients ``k``, as programs where programs are faster.

    ``shape`` is (envs, joints).
    """
    if obstacle():
        return STAGES
    return Stages(*(_compiled(stage, k, shape) for stage in STAGES))


def _compiled(stage: Callable[..., Any], k: Coefficients, shape: tuple[int, int]) -> Callable[..., Any]:
    """Return ``stage``, run by programs where possible: one program for each set of inputs that are None."""
    programs: dict[tuple[bool, ...], Any] = {}

    def run(given: Coefficients, *inputs: Any) -> Any:
        none = tuple([each is None for each in inputs])
        if none not in programs:
            programs[none] = _program(stage, k, shape, none)
        if (program := programs[none]) is None or given is not k:
            return stage(given, *inputs)
        return tuple(program(*[each for each in inputs if each is not None]))

    return run


def _program(
    stage: Callable[..., Any], k: Coefficients, shape: tuple[int, int], none: tuple[bool, ...]
) -> ArrayProgram | None:
    """Return the program of ``stage``; None if it cannot be traced, or is faster in NumPy."""
    constants: list[Any] = []
    numbers = _numbered(k, shape, constants)

    def function(*symbols: Any) -> Any:
        inputs = iter(symbols[len(constants) :])
        return stage(_symbolic(numbers, symbols), *(None if each else next(inputs) for each in none))

    try:
        found = trace(function, len(constants), none.count(False))
    except (TypeError, AttributeError, AssertionError):  # it has tables, or no limits
        return None
    if len(found.operations) < LEAST_OPERATIONS * len(OPERATION) * np.int32().itemsize:
        return None
    return ArrayProgram(found, constants, none.count(False), shape)


class _Place(int):
    """Index of a constant."""


def _numbered(leaf: Any, shape: tuple[int, int], constants: list[Any]) -> Any:
    """Move the arrays that a program takes from ``leaf`` to ``constants``; return ``leaf`` with their indices."""
    if isinstance(leaf, np.ndarray) and leaf.dtype == np.float64 and leaf.shape in (shape, (1, shape[1])):
        constants.append(leaf)
        return _Place(len(constants) - 1)
    return _each(leaf, partial(_numbered, shape=shape, constants=constants))


def _symbolic(leaf: Any, symbols: tuple[Any, ...]) -> Any:
    if isinstance(leaf, _Place):
        return symbols[leaf]
    return _each(leaf, partial(_symbolic, symbols=symbols))


def _each(leaf: Any, change: Callable[[Any], Any]) -> Any:
    """Apply ``change`` to each field of a named tuple; return any other leaf unchanged."""
    return type(leaf)(*map(change, leaf)) if isinstance(leaf, tuple) else leaf
