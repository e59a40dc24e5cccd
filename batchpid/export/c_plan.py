"""A plan in C: chunks of actions are added when they come, and sampled at any time.

The functions of a joint are traced from :mod:`batchpid.plan.sampling`, and the rows of a chunk are
blended by the same operations in the same order. So samples are bit-identical, too.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Pytree
from batchpid.arrays.trees import leaves, structure
from batchpid.export.c_step import Dialect, helpers, statements
from batchpid.motors.guard import GuardState
from batchpid.native.tracing import trace_trees
from batchpid.plan import sampling as model
from batchpid.plan.plans import SPARE_ROWS, Plan
from batchpid.plan.sampling import PlanState

TIMES = ("begin", "last", "end", "now", "starved")
"""Fields of a plan's state that are one number for all joints."""


def plan_functions(c: Dialect, plan: Plan, functions: str) -> str:
    """Return the functions of a plan; ``functions`` is the text before them, whose helpers are not
    repeated.
    """
    p, t, n, f = c.prefix, c.type, c.size, c.suffix
    zero, half, one = map(c.number, (0.0, 0.5, 1.0))
    horizon, knots = f"{p.upper()}_HORIZON", f"{p.upper()}_KNOTS"
    like = model.init(plan, np.zeros((1, c.joints), c.dtype))
    # The leaves of the state by the names that they have in C.
    tables = ["knots", "rates"] if like.weights is None else ["knots", "rates", "weights"]
    segment = [f"state->segment[{i}][j]" for i in range(4)]
    limits = [] if like.guard is None else list(GuardState._fields)
    held = [f"state->{name}[j]" for name in limits]
    names = [f"state->{name}[j]" for name in tables]
    names += ["begin0", "last0", *segment, "end0", "now0", "starved0", *held]
    constants = {f"k_{name}": leaf[0] for name, leaf in plan.leaves().items()}

    def body(step: Callable[..., Pytree], inputs: list[str], places: list[str]) -> str:
        """Return the statements of ``step(plan, state, *inputs)``, with results in ``places``."""

        def flat(k: Plan, state: PlanState, given: Any) -> list[Any]:
            return leaves(step(k, state, *given))

        trees = plan, like, (...,) * len(inputs)
        traced = trace_trees(flat, *map(structure, trees), dtype=c.dtype)
        # A number of all joints is a literal, for the compiler to fold; others are tables.
        read = [f"{k}[j]" if np.ptp(row) else c.number(row[0]) for k, row in constants.items()]
        read += map(c.number, traced.literals)
        text = statements(c, traced, [*read, *names, *inputs], len(read), places)
        tables = [c.table(k, row) for k, row in constants.items() if f"{k}[" in text]
        # Times are read once: for a compiler, writes to the other arrays might change them.
        times = [
            f"  const {t} {name}0 = state->{name};\n"
            for name in TIMES
            if re.search(rf"\b{name}0\b", text)
        ]
        return "".join(["  {\n", *tables, *times, text, "  }\n"])

    def sampled(k: Plan, state: PlanState, *now: Any) -> Pytree:
        state, setpoint, rate, _ = model.advance(k, state, *now)
        return state.guard, setpoint, rate

    def present(k: Plan, state: PlanState) -> Pytree:
        return model.evaluate(state.segment, state.now - state.end)[:2]

    def joined(k: Plan, state: PlanState, *knots: Any) -> Pytree:
        return model.cubic(k, *knots)

    step = [f"chunk[k * {n} + j]", "begin", "offset[j]", "slope[j]", "first", "step", "rows"]
    ends = ["(end - now)", "position[j]", "blended[f][j]", "speed[j]", "state->rates[j][f]"]
    renewal = body(model.segment_at, ["t"], ["state->end", *segment])
    sampling = body(sampled, ["t", "dt"], [*held, "setpoint[j]", "rate[j]"])
    presence = body(present, [], ["position[j]", "speed[j]"])
    gap = body(model.curve, ["end"], ["offset[j]", "slope[j]"])
    blending = body(model.blend, step, ["blended[k][j]", "weights[k][j]"][: len(tables) - 1])
    joining = body(joined, ends, segment)
    called = f"{renewal}{sampling}{presence}{gap}{blending}{joining} {p}_max( {p}_min("
    helped = "".join(text for text in helpers(c, called) if text not in functions)
    fields = "".join(f"  {t} {name}[{n}];\n" for name in limits)
    weighted = ""
    if like.weights is not None:
        weighted = f"      state->weights[j][i] = i < end_row ? weights[i][j] : {zero};\n"
    starts = "".join(f"    {place} = {zero if 'rate' in place else 'qpos[j]'};\n" for place in held)
    return f"""{helped}
enum {{ {horizon} = {plan.horizon}, {knots} = {plan.horizon + SPARE_ROWS} }};

/* Memory of a plan. */
typedef struct {{
  {t} {", ".join(f"{name}[{n}][{knots}]" for name in tables)};
  {t} segment[4][{n}]; /* position and rate at its end, coefficients of square and cube */
  {t} begin, last, end, now; /* of first and last row, of the segment, of the last sample [s] */
  {t} starved; /* samples later than the last row */
{fields}}} {p}_plan;

/* Start at rest at a time [s]. */
static inline void {p}_plan_init({p}_plan *state, const {t} qpos[{n}], {t} time) {{
  static {p}_plan empty;
  *state = empty;
  state->begin = state->last = state->end = state->now = time;
  for (int j = 0; j < {n}; ++j) {{
    state->segment[0][j] = qpos[j];
{starts}    for (int k = 0; k < {knots}; ++k) state->knots[j][k] = qpos[j];
  }}
}}

/* Setpoint [rad or m] and its rate at a time t [s], no earlier than that of the last sample. */
static inline void {p}_sample({p}_plan *state, {t} t, {t} setpoint[{n}], {t} rate[{n}]) {{
  const {t} dt = {p}_max(t - state->now, {c.number(model.LEAST_STEP)});
  if (t >= state->end)
{renewal}{sampling}  if (t > state->last) state->starved += {one};
  state->now = t;
  (void)dt;
}}

/* Add a chunk of n rows, at most {horizon}: setpoints at the times time + k period [s]. */
static inline void {p}_add_chunk({p}_plan *state, const {t} *chunk, int n, {t} time) {{
  const {t} period = {c.number(float(plan.period[0, 0]))}, now = state->now;
  const {t} rows = ({t})(n < {horizon} ? n : {horizon});
  const {t} ahead = {p}_max(ceil{f}((now - time) / period + {half}), {zero});
  const {t} first = {p}_min(ahead, rows - {one});
  const {t} begin = ahead > first ? now + ({one} - first) * period : time;
  const {t} end = begin + first * period;
  const int end_row = (int)rows, f = (int)first;
  const int low = f > 0 ? f - 1 : 0, high = f + 1 < end_row ? f + 1 : end_row - 1;
  {t} blended[{horizon}][{n}], weights[{horizon}][{n}], offset[{n}], slope[{n}];
  {t} position[{n}], speed[{n}];
  if (end_row < 1) return;
{presence}{gap}  for (int j = 0; j < {n}; ++j) {{
    const {t} rise = chunk[high * {n} + j] - chunk[low * {n} + j];
    offset[j] = end_row > 1 ? offset[j] - chunk[f * {n} + j] : {zero};
    slope[j] = end_row > 1 ? slope[j] - rise / (({t})(high - low) * period) : {zero};
  }}
  for (int k = 0; k < end_row; ++k) {{
    const {t} step = ({t})k;
{blending}    (void)step;
  }}
  for (int j = 0; j < {n}; ++j) {{
    for (int i = 0; i < {knots}; ++i) {{
      const int k = i < end_row ? i : end_row - 1;
      const {t} before = blended[k][j] - (k > 0 ? blended[k - 1][j] : position[j]);
      const {t} after = k + 1 < end_row ? blended[k + 1][j] - blended[k][j] : before;
      const {t} rise = k > 0 && k + 1 < end_row ? {half} * (after + before) : after;
      state->knots[j][i] = blended[k][j];
      state->rates[j][i] = i < end_row ? rise / period : {zero};
{weighted}    }}
  }}
{joining}  state->begin = begin;
  state->end = end;
  state->last = begin + (rows - {one}) * period;
  (void)weights;
}}

"""
