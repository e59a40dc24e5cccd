"""C++ functions of the commonest laws and control loops, each one pass over its arrays.

The interpreter (batchpid/native/program.h) makes a pass over a block for each operation, which
loads and stores every value in between. A law whose segments
(:class:`batchpid.native.tracing.Segment`) stand here is one loop. ``setup.py`` writes the headers
from the traces when it builds the extensions. The operations, their order and so all bits are those
of the interpreter, which runs all other programs.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np

from batchpid.arrays.trees import structure
from batchpid.law.coefficients import discretise
from batchpid.law.params import make_params
from batchpid.law.pid import init
from batchpid.motors.coupling import Coupling
from batchpid.motors.friction import Friction
from batchpid.native.compiled import law_trace
from batchpid.native.tracing import Segment
from batchpid.stages import stages_of
from batchpid.stages.control import Control
from batchpid.stages.program import traced_stages
from batchpid.stages.stage import started
from batchpid.stages.values import Command, Measured, Step, Values

BESIDE_P: tuple[dict[str, float], ...] = (
    {},
    {"ki": 1.0},
    {"kd": 1.0},
    {"ki": 1.0, "kd": 1.0},
)
"""Gains beside kp of P, PI, PD and PID."""
ANTI_WINDUPS = ("none", "clamp", "conditional", "back_calculation")
FILTER_TIMES = (None, 0.01)
DESIGNED = {"gain_units": "mass_matrix", "derivative_filter_time": 0.01, "setpoint_weight": 0.1}
"""Options of gains per mass matrix, as :func:`batchpid.design_gains` has them."""
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
        trees = discretise(params, 1.0), init(params, NUMBERS), inputs
        trace, _ = law_trace(structure(trees), False, np.dtype(float))
        yield from trace.segments


def loop_segments() -> Iterator[Segment]:
    """Yield the segments of control loops with PID and compensated passive force: gains in efforts
    and per mass matrix, joints with and without damping, setpoints that rest and that move.
    """
    matrix = np.zeros((1, 1, 1))
    for options, damping, moves in product(({}, DESIGNED), (None, NUMBERS), (False, True)):
        params = make_params(
            1,
            kp=1.0,
            ki=1.0,
            kd=1.0,
            effort_limit=1.0,
            anti_windup="conditional",
            measurement_rate="measured",
            **options,
        )
        control = Control(
            1.0,
            1,
            Coupling.of(1),
            params,
            friction=Friction(viscous=damping),
            gravity=True,
            coriolis=True,
            damping=damping,
        )
        stages = [stage for stage in stages_of(control) if not stage.native]
        command = Command(NUMBERS, NUMBERS, NUMBERS, NUMBERS)
        measured = Measured(NUMBERS, NUMBERS, NUMBERS)
        values = Values(
            command=command if moves else command.resting(),
            measured=measured,
            seen=measured,
            timestep=1.0,
            step=Step(0, 1, np.zeros(()) if moves else None),
            matrix=matrix if options else None,
        )
        *_, traced = traced_stages(stages, started(stages, values), values)
        yield from traced.program.segments


def headers() -> dict[str, str]:
    """Return the texts of the headers in batchpid/native, by name: laws for BatchPID, in float and
    double, and loops for runners, in double.
    """
    return {
        "fused_laws.h": _header("FUSED_LAWS", law_segments(), ("float", "double")),
        "fused_loops.h": _header("FUSED_LOOPS", loop_segments(), ("double",)),
    }


def _header(table: str, segments: Iterator[Segment], types: tuple[str, ...]) -> str:
    """Return the text of a header with a ``table`` of passes."""
    codes = dict.fromkeys(segment.code for segment in segments)
    functions, rows = list[str](), list[str]()
    for number, code in enumerate(codes):
        name = f"{table.lower()}_{number}"
        functions.append(_function(name, code, types))
        single = f"{name}_float" if "float" in types else "nullptr"
        rows.append(f"    {{{len(code) // 4}, {name}_code, {single}, {name}_double}},")
    return _HEADER.format(table=table, functions="\n".join(functions), rows="\n".join(rows))


def _function(name: str, packed: bytes, types: tuple[str, ...]) -> str:
    """Return the pass of a segment."""
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
    clones = [_CLONE.format(name=name, type=kind) for kind in types]
    return _PASS.format(
        name=name,
        code=", ".join(map(str, (read, kept, *code))),
        pointers=", ".join(pointers),
        results=", ".join(results),
        lines="\n      ".join(lines),
        clones="".join(clones),
    )


_PASS = """
constexpr std::int32_t {name}_code[] = {{{code}}};
template <class T>
BATCHPID_INLINE void {name}(Operand<T> const *x, T *const *y, Index n, Index chunk) {{
  for (Index start = 0, at = 0; start < n; start += chunk, ++at) {{
    T const {pointers};
    T {results};
    Index const count = std::min(chunk, n - start);
    _Pragma("GCC ivdep") for (Index i = 0; i < count; ++i) {{
      {lines}
    }}
  }}
}}
{clones}"""
_CLONE = """BATCHPID_CLONES static void {name}_{type}(Operand<{type}> const *x, {type} *const *y, Index n, Index chunk) {{
  {name}(x, y, n, chunk);
}}
"""
_HEADER = """// Written by setup.py: batchpid/stages/passes.py.

#pragma once

#include "program.h"

namespace batchpid {{
namespace detail {{
{functions}
static Fused const {table}[] = {{
{rows}
}};
}}  // namespace detail
}}  // namespace batchpid
"""
