"""The law, and the stages of the actuators, as native programs, traced from their only definitions.

Results are bit-identical. The programs of the stages are for control steps that are not a program
as a whole: those with a controller of the caller's, or of the backend "jax".
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np

from batchpid.arrays.array_types import DType, Rows
from batchpid.arrays.trees import leaves, mapped, structure
from batchpid.law.coefficients import Coefficients
from batchpid.law.pid import advance
from batchpid.law.state import PIDState, Terms
from batchpid.motors import STAGES, MotorCoefficients, Stages
from batchpid.native.array_program import ArrayProgram
from batchpid.native.availability import obstacle
from batchpid.native.operations import OPERATION
from batchpid.native.tracing import Trace, trace_trees

_MEASUREMENT = 1
"""Index of the measurement among the inputs: the only input that must be (envs, joints)."""


@lru_cache(maxsize=256)
def _trace(structures: tuple[Any, ...], terms: bool, dtype: DType) -> tuple[Trace, tuple[int, ...]]:
    """Return the law's trace, and the indices of the state leaves that it returns before its other
    results.

    ``structures`` describe coefficients, state and inputs.
    """
    kept: list[int] = []

    def function(k: Coefficients, state: PIDState, inputs: tuple[Any, ...]) -> list[Any]:
        new, found = advance(k, state, *inputs)
        kept[:] = [at for at, leaf in enumerate(new) if leaf is not None]
        return [*(new[at] for at in kept), *(found.filled() if terms else ()), found.effort]

    return trace_trees(function, *structures, dtype=dtype), tuple(kept)


class CompiledLaw:
    """:func:`batchpid.advance` for coefficients ``k`` (1 | envs, joints), on arrays of their
    dtype.
    """

    def __init__(self, k: Coefficients, num_envs: int, terms: bool, threads: int | None) -> None:
        self._k = k
        self._terms = terms
        self._threads = threads
        self._shape = num_envs, k.kp.shape[1]
        self._programs: dict[tuple[bool, ...], tuple[ArrayProgram, tuple[int, ...]]] = {}

    def _program(
        self, state: PIDState, inputs: tuple[Any, ...]
    ) -> tuple[ArrayProgram, tuple[int, ...]]:
        """Return the program for a state and inputs like these, and the state indices that it
        returns.
        """
        key = tuple([leaf is None for leaf in (*state, *inputs)])
        if key not in self._programs:
            dtype = self._k.kp.dtype
            traced, kept = _trace(structure((self._k, state, inputs)), self._terms, dtype)
            program = ArrayProgram(
                traced, leaves(self._k), key.count(False), self._shape, dtype, self._threads
            )
            self._programs[key] = program, kept
        return self._programs[key]

    def step(
        self, state: PIDState, inputs: tuple[Rows | None, ...], out: Rows | None
    ) -> tuple[PIDState, Any, Terms | None, Callable[..., Any] | None]:
        """Advance the law; return the new state, the effort, the terms, and a fast function for the
        next steps.

        The new state is written into the arrays of ``state``. The fast function advances this state
        in place, for ``out`` and the same kinds of inputs: see :meth:`ArrayProgram.bind`.
        """
        given = [each for each in inputs if each is not None]
        state = PIDState(*(None if leaf is None else self._whole(leaf) for leaf in state))
        program, kept = self._program(state, inputs)
        fixed = [leaf for leaf in state if leaf is not None]
        written = [state[at] for at in kept]
        masks = program.masks[len(kept) :]
        effort = np.empty(self._shape, program.dtype) if out is None else out
        shown = [
            np.empty(self._shape, bool if is_mask else program.dtype) for is_mask in masks[:-1]
        ]
        read = [
            each if out is None or not np.may_share_memory(each, out) else each.copy()
            for each in given
        ]
        program(*fixed, *read, out=(*written, *shown, effort))
        if self._terms:
            return state, effort, Terms(*shown)._replace(effort=effort), None
        bits = sum((each is not None) << at for at, each in enumerate(inputs))
        return state, effort, None, program.bind(fixed, written, bits, 1 << _MEASUREMENT)

    def _whole(self, leaf: Rows) -> Rows:
        """Return a leaf of the state as a contiguous array (envs, joints); a row that all envs
        share is repeated.
        """
        return np.ascontiguousarray(
            leaf if leaf.shape == self._shape else np.broadcast_to(leaf, self._shape)
        )


LEAST_OPERATIONS = 3
"""Least number of operations for which a call of the extension is faster than NumPy."""


def compiled_stages(k: MotorCoefficients, shape: tuple[int, int]) -> Stages:
    """Return the stages of actuators with coefficients ``k``, as programs where programs are
    faster.

    ``shape`` is (envs, joints).
    """
    if obstacle():
        return STAGES
    return Stages(*(_compiled(stage, k, shape) for stage in STAGES))


def _compiled(
    stage: Callable[..., Any], k: MotorCoefficients, shape: tuple[int, int]
) -> Callable[..., Any]:
    """Return ``stage``, run by programs where possible: one program for each set of inputs that are
    None.
    """
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
    except (
        TypeError,
        AttributeError,
    ):  # without limits, or with operations that programs lack: NumPy runs it
        return None
    if len(found.operations) < LEAST_OPERATIONS * len(OPERATION) * np.int32().itemsize:
        return None
    return ArrayProgram(found, leaves(k), none.count(False), shape)
