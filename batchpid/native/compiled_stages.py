"""Elementwise stages of a sim step as programs of the extension: one call executes all operations of a stage.

The only definition is traced, and results are bit-identical. They are for control steps that are not a program as a
whole: those with a controller of the caller's, or of the backend "jax".
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from batchpid.arrays.trees import leaves, mapped, structure
from batchpid.motors import STAGES, MotorCoefficients, Stages
from batchpid.native.array_program import ArrayProgram
from batchpid.native.availability import obstacle
from batchpid.native.operations import OPERATION
from batchpid.native.tracing import trace_trees

LEAST_OPERATIONS = 3
"""Least number of operations for which a call of the extension is faster than NumPy."""


def compiled_stages(k: MotorCoefficients, shape: tuple[int, int]) -> Stages:
    """Return the stages of actuators with coefficients ``k``, as programs where programs are faster.

    ``shape`` is (envs, joints).
    """
    if obstacle():
        return STAGES
    return Stages(*(_compiled(stage, k, shape) for stage in STAGES))


def _compiled(stage: Callable[..., Any], k: MotorCoefficients, shape: tuple[int, int]) -> Callable[..., Any]:
    """Return ``stage``, run by programs where possible: one program for each set of inputs that are None."""
    programs: dict[tuple[bool, ...], Any] = {}

    def run(given: MotorCoefficients, *inputs: Any) -> Any:
        none = tuple([each is None for each in inputs])
        if none not in programs:
            programs[none] = _program(stage, k, shape, none)
        if (program := programs[none]) is None or given is not k:
            return stage(given, *inputs)
        return tuple(program(*[each for each in inputs if each is not None]))

    return run


def _program(
    stage: Callable[..., Any], k: MotorCoefficients, shape: tuple[int, int], none: tuple[bool, ...]
) -> ArrayProgram | None:
    """Return the program of ``stage``; None if it cannot be traced, or is faster in NumPy."""
    k = mapped(lambda leaf: tuple(leaf) if leaf.ndim == 3 else leaf, k)
    inputs = tuple([None if each else ... for each in none])
    try:
        found = trace_trees(lambda k, given: stage(k, *given), structure(k), inputs)
    except (TypeError, AttributeError):  # without limits, or with operations that programs lack: NumPy runs it
        return None
    if len(found.operations) < LEAST_OPERATIONS * len(OPERATION) * np.int32().itemsize:
        return None
    return ArrayProgram(found, leaves(k), none.count(False), shape)
