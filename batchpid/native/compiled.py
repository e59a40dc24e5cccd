"""The law as a native program, traced from its only definition. Results are bit-identical."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Array, DType, Rows
from batchpid.arrays.trees import leaves, structure
from batchpid.law.coefficients import Coefficients
from batchpid.law.pid import advance
from batchpid.law.state import PIDState, Terms
from batchpid.native.array_program import ArrayProgram
from batchpid.native.tracing import Trace, trace_trees

_MEASUREMENT = 1
"""Index of the measurement among the inputs: the only input that must be (envs, joints)."""


@lru_cache(maxsize=256)
def law_trace(
    structures: tuple[Any, ...], terms: bool, dtype: DType
) -> tuple[Trace, tuple[int, ...]]:
    """Return the law's trace, and the indices of the state leaves that it returns before its other
    results.

    ``structures`` describe coefficients, state and inputs.
    """
    lasting: list[int] = []

    def function(k: Coefficients, state: PIDState, inputs: tuple[Any, ...]) -> list[Array]:
        new, result = advance(k, state, *inputs)
        lasting[:] = [at for at, leaf in enumerate(new) if leaf is not None]
        return [*(new[at] for at in lasting), *(result.filled() if terms else ()), result.effort]

    return trace_trees(function, *structures, dtype=dtype), tuple(lasting)


class CompiledLaw:
    """:func:`batchpid.advance` for coefficients ``k`` (1 | envs, joints), on arrays of their
    dtype.
    """

    def __init__(
        self,
        k: Coefficients,
        num_envs: int,
        terms: bool,
        threads: int | None,
    ) -> None:
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
        # Inputs that are left out make another program.
        key = tuple([leaf is None for leaf in (*state, *inputs)])
        if key not in self._programs:
            dtype = self._k.kp.dtype
            traced, lasting = law_trace(structure((self._k, state, inputs)), self._terms, dtype)
            program = ArrayProgram(
                traced, leaves(self._k), key.count(False), self._shape, dtype, self._threads
            )
            self._programs[key] = program, lasting
        return self._programs[key]

    def step(
        self, state: PIDState, inputs: tuple[Rows | None, ...], out: Rows | None
    ) -> tuple[PIDState, Array, Terms | None, Callable[..., Rows] | None]:
        """Advance the law; return the new state, the effort, the terms, and a fast function for the
        next steps.

        The new state is written into the arrays of ``state``. The fast function advances this state
        in place, for ``out`` and the same kinds of inputs: see :meth:`ArrayProgram.bind`.
        """
        arguments = [entry for entry in inputs if entry is not None]
        state = PIDState(*(None if leaf is None else self._whole(leaf) for leaf in state))
        program, lasting = self._program(state, inputs)
        # A step writes the new state over the old one.
        fixed = [leaf for leaf in state if leaf is not None]
        written = [state[at] for at in lasting]
        masks = program.masks[len(lasting) :]
        if out is None:
            effort = np.empty(self._shape, program.dtype)
        else:
            effort = out
        shown = [
            np.empty(self._shape, bool if is_mask else program.dtype) for is_mask in masks[:-1]
        ]
        # An input that shares memory with the result is read before it is overwritten.
        read = [
            entry if out is None or not np.may_share_memory(entry, out) else entry.copy()
            for entry in arguments
        ]
        program(*fixed, *read, out=(*written, *shown, effort))
        # The fast function writes into the same arrays at every step; terms need new ones.
        if self._terms:
            return state, effort, Terms(*shown)._replace(effort=effort), None
        bits = sum((entry is not None) << at for at, entry in enumerate(inputs))
        return state, effort, None, program.bind(fixed, written, bits, 1 << _MEASUREMENT)

    def _whole(self, leaf: Rows) -> Rows:
        """Return a leaf of the state as a contiguous array (envs, joints); a row that all envs
        share is repeated.
        """
        return np.ascontiguousarray(
            leaf if leaf.shape == self._shape else np.broadcast_to(leaf, self._shape)
        )
