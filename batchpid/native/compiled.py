"""The law as a native program, traced from its only definition. Results are bit-identical.

The interpreter (program.h) makes a pass over a block for each operation, which loads and stores
every value in between. A program whose segments (:class:`batchpid.native.tracing.Segment`) are those
of :func:`law_segments`, or in the sim's extension of :func:`batchpid.stages.control_segments`, has
one loop for each: ``setup.py`` writes them into headers ``passes.h`` when it builds the extensions.
The interpreter runs all other programs. It has the same operations in the same order, so all bits
are equal.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from itertools import product
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Array, Rows
from batchpid.arrays.trees import leaves, structure
from batchpid.law.coefficients import Coefficients, discretise
from batchpid.law.params import make_params
from batchpid.law.pid import advance, init
from batchpid.law.state import PIDState
from batchpid.native.array_program import TreeProgram
from batchpid.native.tracing import Segment, trace_change

_MEASUREMENT = 1
"""Index of the measurement among the inputs: the only input that must be (envs, joints)."""


def law(
    k: Coefficients, state: PIDState, inputs: tuple[Any, ...]
) -> tuple[PIDState, Array, tuple[()]]:
    """Return the state and the effort of a step, as for :class:`.TreeProgram`."""
    new, terms = advance(k, state, *inputs)
    # A state may have arrays that these coefficients do not need.
    new = PIDState(*[old if leaf is None else leaf for old, leaf in zip(state, new, strict=True)])
    return new, terms.effort, ()


class CompiledLaw:
    """:func:`batchpid.advance` for coefficients ``k`` (1 | envs, joints), on arrays of their
    dtype.
    """

    def __init__(self, k: Coefficients, num_envs: int) -> None:
        self._k = k
        self._shape = num_envs, k.kp.shape[1]
        self._programs: dict[tuple[bool, ...], TreeProgram] = {}

    def step(
        self, state: PIDState, inputs: tuple[Rows | None, ...], out: Rows | None
    ) -> tuple[PIDState, Array, Callable[..., Rows]]:
        """Advance the law; return the new state, the effort, and a fast function for the next
        steps.

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
                law,
                self._k,
                state,
                inputs,
                self._shape,
                self._k.kp.dtype,
            )
        tree = self._programs[key]
        bound = tree.bind(state, inputs, out)
        tree.program(*bound.inputs, out=bound.outputs)
        inputs_mask = sum((entry is not None) << at for at, entry in enumerate(inputs))
        written = bound.outputs[:-1]
        fast = tree.program.bind(leaves(state), written, inputs_mask, 1 << _MEASUREMENT)
        return state, bound.after[1], fast

    def _whole(self, leaf: Rows) -> Rows:
        """Return a leaf of the state as a contiguous array (envs, joints); a row that all envs
        share is repeated.
        """
        return np.ascontiguousarray(
            leaf if leaf.shape == self._shape else np.broadcast_to(leaf, self._shape)
        )


def _overlap(entry: Rows, out: Rows | None) -> bool:
    return out is not None and np.may_share_memory(entry, out)


BESIDE_P: tuple[dict[str, Any], ...] = (
    {},
    {"ki": 1.0},
    {"kd": 1.0},
    {"ki": 1.0, "kd": 1.0},
)
"""Gains of P, PI, PD and PID in addition to kp."""
ANTI_WINDUPS = ("none", "clamp", "conditional", "back_calculation")
FILTER_TIMES = (None, 0.01)
NUMBERS = np.zeros((1, 1))


def law_segments() -> Iterator[Segment]:
    """Yield the segments of P, PI, PD and PID with effort limits, with each strategy of
    anti-windup, with and without derivative filter and feedforward.
    """
    for gains, strategy, time, feedforward in product(
        BESIDE_P, ANTI_WINDUPS, FILTER_TIMES, (None, NUMBERS)
    ):
        # What has no gain has no option.
        if (strategy != "none" and "ki" not in gains) or (time is not None and "kd" not in gains):
            continue
        params = make_params(
            1,
            kp=1.0,
            **gains,
            effort_limit=1.0,
            anti_windup=strategy,
            derivative_filter_time=time,
        )
        inputs = (NUMBERS, NUMBERS, None, None, feedforward)
        state = init(params, NUMBERS)
        trees = map(structure, (discretise(params, 1.0), state, inputs))
        histories = (False,) * len(leaves(state))
        yield from trace_change(law, histories, *trees).program.segments


def header(segments: Iterable[Segment], dtypes: tuple[str, ...]) -> str:
    """Return the text of a header with a pass for each of the segments and ``dtypes``, "float" and
    "double".
    """
    codes = dict.fromkeys(segment.code for segment in segments)
    functions = [_function(number, code, dtypes) for number, code in enumerate(codes)]
    rows = []
    for number, code in enumerate(codes):
        passes = [
            f"detail::{dtype}_{number}" if dtype in dtypes else "nullptr"
            for dtype in ("float", "double")
        ]
        rows.append(f"    {{{len(code) // 4}, detail::code_{number}, {', '.join(passes)}}},")
    return _HEADER.format(functions="\n".join(functions), rows="\n".join(rows))


def _function(number: int, packed: bytes, dtypes: Iterable[str]) -> str:
    """Return the pass of a segment."""
    read, count, *code = np.frombuffer(packed, np.int32).tolist()
    operations = [code[start : start + 4] for start in range(0, len(code) - count, 4)]
    pointers = [f"*x{i} = x[{i}].data + at * x[{i}].step" for i in range(read)]
    lines = [f"T const v{i} = x{i}[i];" for i in range(read)]
    for value, (operation, *operands) in enumerate(operations, read):
        names = ", ".join(f"v{operand}" for operand in operands)
        lines.append(f"T const v{value} = result_of<Code({operation}), T>({names});")
    # All operands are read before a result is written: they may share memory.
    lines += [f"y{i}[i] = v{value};" for i, value in enumerate(code[-count:])]
    results = [f"*y{i} = y[{i}] + start" for i in range(count)]
    return _PASS.format(
        number=number,
        code=", ".join(map(str, (read, count, *code))),
        pointers=", ".join(pointers),
        results=", ".join(results),
        lines="\n      ".join(lines),
    ) + "".join(_TYPED.format(number=number, dtype=dtype) for dtype in dtypes)


_PASS = """
constexpr std::int32_t code_{number}[] = {{{code}}};
template <class T>
BATCHPID_INLINE void pass_{number}(Operand<T> const *x, T *const *y, Index n, Index chunk) {{
  for (Index start = 0, at = 0; start < n; start += chunk, ++at) {{
    T const {pointers};
    T {results};
    Index const count = std::min(chunk, n - start);
    _Pragma("GCC ivdep") for (Index i = 0; i < count; ++i) {{
      {lines}
    }}
  }}
}}
"""
_TYPED = """
BATCHPID_CLONES static void {dtype}_{number}(Operand<{dtype}> const *x, {dtype} *const *y, Index n, Index chunk) {{
  pass_{number}(x, y, n, chunk);
}}"""
_HEADER = """// Written by setup.py: batchpid/native/compiled.py.

#pragma once

#include "batchpid/native/program.h"

namespace batchpid {{
namespace detail {{
#pragma GCC push_options
#pragma GCC optimize("no-tree-pre")  // with it GCC does not vectorize a pass with two limits
{functions}
#pragma GCC pop_options
}}  // namespace detail

static Fused const PASSES[] = {{
{rows}
}};
}}  // namespace batchpid
"""
