"""C++ functions of the commonest laws, each one pass over its arrays.

The interpreter (program.h) makes a pass over a block for each operation, which loads and stores
every value in between. A law whose segments (:class:`batchpid.native.tracing.Segment`) stand here
is one loop. ``setup.py`` writes ``fused.h`` from the traces when it builds the extensions. The
operations, their order and so all bits are those of the interpreter, which runs all other programs.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np

from batchpid.arrays.trees import structure
from batchpid.law.coefficients import discretise
from batchpid.law.params import make_params
from batchpid.law.pid import init
from batchpid.native.compiled import law_trace
from batchpid.native.tracing import Segment

BESIDE_P: tuple[dict[str, float], ...] = (
    {},
    {"ki": 1.0},
    {"kd": 1.0},
    {"ki": 1.0, "kd": 1.0},
)
"""Gains beside kp of P, PI, PD and PID."""
ANTI_WINDUPS = ("none", "clamp", "conditional", "back_calculation")
FILTER_TIMES = (None, 0.01)


def segments() -> Iterator[Segment]:
    """Yield the segments of P, PI, PD and PID with effort limits, with each strategy of
    anti-windup, with and without derivative filter and feedforward.
    """
    numbers = np.zeros((1, 1))
    for gains, strategy, time, feedforward in product(
        BESIDE_P, ANTI_WINDUPS, FILTER_TIMES, (None, numbers)
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
        inputs = (numbers, numbers, None, None, feedforward)
        trees = discretise(params, 1.0), init(params, numbers), inputs
        trace, _ = law_trace(structure(trees), False, np.dtype(float))
        yield from trace.segments


def header() -> str:
    """Return the text of fused.h."""
    codes = dict.fromkeys(segment.code for segment in segments())
    functions = [_function(at, code) for at, code in enumerate(codes)]
    rows = [_row(at, code) for at, code in enumerate(codes)]
    return _HEADER.format(functions="\n".join(functions), rows="\n".join(rows))


def _function(at: int, packed: bytes) -> str:
    """Return the pass of a segment, in float and double."""
    read, kept, *code = np.frombuffer(packed, np.int32).tolist()
    operations = [code[start : start + 4] for start in range(0, len(code) - kept, 4)]
    pointers = [f"*x{i} = x[{i}].data + at * x[{i}].step" for i in range(read)]
    lines = [f"T const v{i} = x{i}[i];" for i in range(read)]
    for number, (operation, *operands) in enumerate(operations):
        names = ", ".join(f"v{operand}" for operand in operands)
        lines.append(f"T const v{read + number} = result_of<Code({operation}), T>({names});")
    # All operands are read before a result is written: they may share memory.
    lines += [f"y{i}[i] = v{value};" for i, value in enumerate(code[-kept:])]
    results = [f"*y{i} = y[{i}] + start" for i in range(kept)]
    newline = "\n      "
    return f"""
constexpr std::int32_t CODE_{at}[] = {{{", ".join(map(str, (read, kept, *code)))}}};
template <class T>
BATCHPID_INLINE void run_{at}(Operand<T> const *x, T *const *y, Index n, Index chunk) {{
  for (Index start = 0, at = 0; start < n; start += chunk, ++at) {{
    T const {", ".join(pointers)};
    T {", ".join(results)};
    Index const count = std::min(chunk, n - start);
    _Pragma("GCC ivdep") for (Index i = 0; i < count; ++i) {{
      {newline.join(lines)}
    }}
  }}
}}
BATCHPID_CLONES static void single_{at}(Operand<float> const *x, float *const *y, Index n, Index chunk) {{
  run_{at}(x, y, n, chunk);
}}
BATCHPID_CLONES static void pass_{at}(Operand<double> const *x, double *const *y, Index n, Index chunk) {{
  run_{at}(x, y, n, chunk);
}}
"""


def _row(at: int, packed: bytes) -> str:
    """Return the row of a segment in the table of passes."""
    size = len(packed) // 4
    names = ", ".join(f"detail::{name}_{at}" for name in ("CODE", "single", "pass"))
    return f"    {{{size}, {names}}},"


_HEADER = """// Passes of the commonest laws. Written by setup.py: batchpid/native/fused.py.

#pragma once

#include "program.h"

namespace batchpid {{
namespace detail {{
{functions}
}}  // namespace detail

static Fused const FUSED[] = {{
{rows}
}};

}}  // namespace batchpid
"""
