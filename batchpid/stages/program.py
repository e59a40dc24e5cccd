"""Consecutive stages as one native program, traced from :func:`batchpid.stages.stage.advanced`
or :func:`batchpid.stages.stage.renewed`.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from batchpid.arrays.array_types import Array, Pytree
from batchpid.arrays.trees import filled, leaves, mapped, structure
from batchpid.native.array_program import ArrayProgram
from batchpid.native.tracing import Trace, trace_trees
from batchpid.stages.stage import States, advanced, renewed, running
from batchpid.stages.values import Values


class StageProgram:
    """Stages, their states, and the values before them, whose arrays it reads.

    It changes the arrays of ``states`` in place. It makes new arrays for the ``values`` that it
    changes: for the outputs alone, or with ``passes`` for all, which stages after it read. With
    ``renews`` it renews the states and changes nothing else.

    Attributes
    ----------
    values
        The values after the stages.
    program, inputs, outputs
        The program and its arrays.

    Raises
    ------
    AttributeError, AssertionError, TypeError
        A stage uses an operation that programs do not have.
    """

    def __init__(
        self,
        stages: Sequence[Any],
        states: States,
        values: Values,
        shape: tuple[int, int],
        passes: bool = False,
        renews: bool = False,
    ) -> None:
        constants = mapped(_split, running(stages))
        # Programs have no keys of noise, counts, or state of a controller.
        states = mapped(_number, tuple(states))
        state, self.inputs = leaves(states), leaves((states, values))
        histories = tuple([array.ndim == 3 for array in state])
        traced = _trace(histories, passes, renews, *map(structure, (constants, states, values)))
        masks = traced.program.masks
        self.outputs = [np.zeros(shape, bool if is_mask else float) for is_mask in masks]
        for array, place in zip(state, traced.places, strict=False):  # the state comes first
            if place >= len(self.inputs):
                self.outputs[place - len(self.inputs)] = array
        arrays = [*self.inputs, *self.outputs]
        _, after = filled(traced.changed, iter([arrays[place] for place in traced.places]))
        self.values = after._replace(noise=None) if passes else values._replace(outputs=after)
        self.program = ArrayProgram(traced.program, leaves(constants), len(self.inputs), shape)

    def __call__(self) -> None:
        """Run the program on its arrays."""
        self.program(*self.inputs, out=self.outputs)


class _Traced(NamedTuple):
    """Program of consecutive stages."""

    program: Trace
    changed: Pytree
    """Structure of the states and the values after it."""
    places: tuple[int, ...]
    """Index of each of their arrays: inputs first, then results."""


@lru_cache(maxsize=64)
def _trace(
    histories: tuple[bool, ...],
    passes: bool,
    renews: bool,
    constants: Any,
    states: Any,
    values: Any,
) -> _Traced:
    """Return the program of stages.

    The last three are structures of the stages, their states and the values before them.
    ``histories`` says which arrays of the states are histories, which a program changes in place.
    """
    count = len(leaves((states, values)))
    parts: list[Any] = []

    def function(stages: Any, states: States, values: Values) -> list[Any]:
        numbers = {symbol: number for number, symbol in enumerate(leaves((states, values)))}
        if renews:
            new, after = renewed(stages, states), values
        else:
            new, after = advanced(stages, states, values)
        changed = new, after if passes else after.outputs
        outputs = set(map(id, leaves(after.outputs)))
        results, places = list[Any](), list[int]()
        for at, leaf in enumerate(leaves(changed)):
            is_state = at < len(histories)
            number = numbers.get(leaf)
            if is_state and (number == at or histories[at]):
                places.append(at)
            # An output that is an input is copied, since the next sim step changes the input.
            elif number is not None and not is_state and id(leaf) not in outputs:
                places.append(number)
            else:
                places.append(count + len(results))
                results.append(leaf)
        parts[:] = structure(changed), tuple(places)
        return results

    program = trace_trees(function, constants, states, values)
    return _Traced(program, *parts)


def _number(array: Array) -> Any:
    """Return an array of numbers in double precision; None for another."""
    return array if array.dtype == np.float64 else None


def _split(array: Array) -> Any:
    """Return an array (n, envs, dof) as a tuple of n arrays, and other arrays unchanged."""
    return tuple(array) if array.ndim == 3 else array
