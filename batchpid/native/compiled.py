"""The law as a native program, traced from its only definition. Results are bit-identical."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Array, Rows
from batchpid.arrays.trees import leaves
from batchpid.law.coefficients import Coefficients
from batchpid.law.pid import advance
from batchpid.law.state import PIDState, Terms
from batchpid.native.array_program import TreeProgram

_MEASUREMENT = 1
"""Index of the measurement among the inputs: the only input that must be (envs, joints)."""


def law_with_terms(
    k: Coefficients, state: PIDState, inputs: tuple[Any, ...]
) -> tuple[PIDState, Any, tuple[()]]:
    """Return the state, and terms and effort of a step, as for :class:`.TreeProgram`."""
    new, terms = advance(k, state, *inputs)
    # A state may have arrays that these coefficients do not need.
    new = PIDState(*[old if leaf is None else leaf for old, leaf in zip(state, new, strict=True)])
    return new, (terms.filled(), terms.effort), ()


def law_with_effort(
    k: Coefficients, state: PIDState, inputs: tuple[Any, ...]
) -> tuple[PIDState, Any, tuple[()]]:
    """Return the state and the effort of a step."""
    new, (_, effort), _ = law_with_terms(k, state, inputs)
    return new, effort, ()


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
        self._law = law_with_terms if terms else law_with_effort
        self._terms = terms
        self._threads = threads
        self._shape = num_envs, k.kp.shape[1]
        self._programs: dict[tuple[bool, ...], TreeProgram] = {}

    def step(
        self, state: PIDState, inputs: tuple[Rows | None, ...], out: Rows | None
    ) -> tuple[PIDState, Array, Terms | None, Callable[..., Rows] | None]:
        """Advance the law; return the new state, the effort, the terms, and a fast function for the
        next steps.

        The new state is written into the arrays of ``state``. The fast function advances this state
        in place, for ``out`` and the same kinds of inputs: see :meth:`ArrayProgram.bind`.
        """
        state = PIDState(*(None if leaf is None else self._whole(leaf) for leaf in state))
        # An input that shares memory with the result is read before it is overwritten.
        inputs = tuple(
            [
                entry if entry is None or not _overlap(entry, out) else entry.copy()
                for entry in inputs
            ]
        )
        # Inputs that are left out make another program.
        key = tuple([leaf is None for leaf in (*state, *inputs)])
        if key not in self._programs:
            self._programs[key] = TreeProgram(
                self._law,
                self._k,
                state,
                inputs,
                self._shape,
                self._k.kp.dtype,
                self._threads,
            )
        tree = self._programs[key]
        bound = tree.bind(state, inputs, out)
        tree.program(*bound.inputs, out=bound.outputs)
        result = bound.after[1]
        # The fast function writes into the same arrays at every step; terms need new ones.
        if self._terms:
            terms, effort = result
            return state, effort, terms._replace(effort=effort), None
        inputs_mask = sum((entry is not None) << at for at, entry in enumerate(inputs))
        written = bound.outputs[:-1]
        fast = tree.program.bind(leaves(state), written, inputs_mask, 1 << _MEASUREMENT)
        return state, result, None, fast

    def _whole(self, leaf: Rows) -> Rows:
        """Return a leaf of the state as a contiguous array (envs, joints); a row that all envs
        share is repeated.
        """
        return np.ascontiguousarray(
            leaf if leaf.shape == self._shape else np.broadcast_to(leaf, self._shape)
        )


def _overlap(entry: Rows, out: Rows | None) -> bool:
    return out is not None and np.may_share_memory(entry, out)
