"""A plan in C: chunks of actions are added when they come, and sampled at any time.

The curve and its limits are traced from :mod:`batchpid.plan.sampling`; the rows of a chunk are
blended by the same operations in the same order. So samples are bit-identical, too.
"""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np

from batchpid.arrays.array_types import Array
from batchpid.arrays.trees import leaves, structure
from batchpid.export.c_step import Dialect, helpers, statements
from batchpid.motors.guard import GuardState
from batchpid.native.tracing import trace_trees
from batchpid.plan.plans import SPARE_ROWS, Plan
from batchpid.plan.sampling import LEAST_STEP, PlanState, advance, blend, curve, init


def plan_functions(c: Dialect, plan: Plan, functions: str) -> str:
    """Return the functions of a plan; ``functions`` is the text before them, whose helpers are not
    repeated.
    """
    p, t, n, f = c.prefix, c.type, c.size, c.suffix
    zero, half = c.number(0.0), c.number(0.5)
    # The state of the plan is traced with the names of the fields in C.
    horizon, knots = f"{p.upper()}_HORIZON", f"{p.upper()}_KNOTS"
    like = init(plan, np.zeros((1, c.joints), c.dtype))
    limits = () if like.guard is None else GuardState._fields
    held = [f"state->{name}[j]" for name in limits]

    def curve_step(k: Plan, state: PlanState, inputs: list[Array]) -> list[Array]:
        return list(curve(k, state, *inputs)[:2])

    def sample_step(k: Plan, state: PlanState, inputs: list[Array]) -> list[Array]:
        state, setpoint, rate, _ = advance(k, state, *inputs)
        return [*leaves(state.guard), setpoint, rate]

    def blend_step(k: Plan, state: PlanState, inputs: list[Array]) -> list[Array]:
        return list(blend(k, state, *inputs))

    outputs = ["setpoint[j]", "rate[j]"]
    inputs = [f"chunk[k * {n} + j]", "begin", "offset[j]", "slope[j]", "first", "step", "rows"]
    curve_body = _body(c, plan, like, curve_step, ["t"], outputs)
    sample_body = _body(c, plan, like, sample_step, ["t", "dt"], [*held, *outputs])
    blend_body = _body(c, plan, like, blend_step, inputs, ["blended[k][j]", "weights[k][j]"])
    called = f"{curve_body}{sample_body}{blend_body} {p}_max( {p}_min("
    helped = "".join(text for text in helpers(c, called) if text not in functions)
    fields = "".join(f"  {t} {name}[{n}];\n" for name in limits)
    starts = "".join(f"    {place} = {zero if 'rate' in place else 'qpos[j]'};\n" for place in held)
    return f"""{helped}
enum {{ {horizon} = {plan.horizon}, {knots} = {plan.horizon + SPARE_ROWS} }};

/* Memory of a plan. */
typedef struct {{
  {t} knots[{n}][{knots}], rates[{n}][{knots}], weights[{n}][{knots}];
  {t} join, time, end, now; /* of the first and second knot, the last row, the last sample [s] */
  {t} starved; /* samples later than the end */
{fields}}} {p}_plan;

/* Start at rest at a time [s]. */
static inline void {p}_plan_init({p}_plan *state, const {t} qpos[{n}], {t} time) {{
  state->join = state->time = state->end = state->now = time;
  state->starved = {zero};
  for (int j = 0; j < {n}; ++j) {{
{starts}    for (int k = 0; k < {knots}; ++k) {{
      state->knots[j][k] = qpos[j];
      state->rates[j][k] = state->weights[j][k] = {zero};
    }}
  }}
}}

/* Position and rate without limits at a time t [s]. */
static inline void {p}_curve(const {p}_plan *state, {t} t, {t} setpoint[{n}], {t} rate[{n}]) {{
{curve_body}}}

/* Setpoint [rad or m] and its rate at a time t [s], no earlier than that of the last sample. */
static inline void {p}_sample({p}_plan *state, {t} t, {t} setpoint[{n}], {t} rate[{n}]) {{
  const {t} dt = {p}_max(t - state->now, {c.number(LEAST_STEP)});
{sample_body}  if (t > state->end) state->starved += {c.number(1.0)};
  state->now = t;
  (void)dt;
}}

/* Add a chunk of n rows, at most {horizon}: setpoints at the times time + k period [s]. */
static inline void {p}_add_chunk({p}_plan *state, const {t} *chunk, int n, {t} begin) {{
  const {t} period = {c.number(float(plan.period[0, 0]))}, now = state->now;
  const {t} rows = ({t})(n < {horizon} ? n : {horizon});
  const {t} ahead = {p}_max(ceil{f}((now - begin) / period + {half}), {zero});
  const {t} first = {p}_min(ahead, rows - {c.number(1.0)});
  const int end = (int)rows;
  {t} blended[{horizon}][{n}], weights[{horizon}][{n}], offset[{n}], slope[{n}];
  {t} position[{n}], rate[{n}];
  const int f = (int)first, low = f > 0 ? f - 1 : 0, high = f + 1 < end ? f + 1 : end - 1;
  if (end < 1) return;
  {p}_curve(state, begin + first * period, offset, slope);
  {p}_curve(state, now, position, rate);
  for (int j = 0; j < {n}; ++j) {{
    const {t} rise = chunk[high * {n} + j] - chunk[low * {n} + j];
    offset[j] = end > 1 ? offset[j] - chunk[f * {n} + j] : {zero};
    slope[j] = end > 1 ? slope[j] - rise / (({t})(high - low) * period) : {zero};
  }}
  for (int k = 0; k < end; ++k) {{
    const {t} step = ({t})k;
{blend_body}    (void)step;
  }}
  state->join = now;
  state->time = ahead > first ? now + period : begin + first * period;
  state->end = state->time + (rows - {c.number(1.0)} - first) * period;
  for (int j = 0; j < {n}; ++j) {{
    state->knots[j][0] = position[j];
    state->rates[j][0] = rate[j];
    state->weights[j][0] = {zero};
    for (int i = 1; i < {knots}; ++i) {{
      const int next = (int)first + i - 1, k = next < end ? next : end - 1;
      const {t} before = blended[k][j] - (k > 0 ? blended[k - 1][j] : position[j]);
      const {t} after = k + 1 < end ? blended[k + 1][j] - blended[k][j] : before;
      const int inner = k > 0 && k + 1 < end;
      state->knots[j][i] = blended[k][j];
      state->rates[j][i] = next < end ? (inner ? {half} * (after + before) : after) / period : {zero};
      state->weights[j][i] = next < end ? weights[k][j] : {zero};
    }}
  }}
}}

"""


def _body(
    c: Dialect,
    plan: Plan,
    like: PlanState,
    step: Callable[[Plan, PlanState, list[Array]], list[Array]],
    inputs: list[str],
    places: list[str],
) -> str:
    """Return the statements of a ``step`` of a plan, with constants, state and ``inputs``; its
    results are written to ``places``.
    """
    trees = plan, like, (...,) * len(inputs)
    traced = trace_trees(step, *map(structure, trees), dtype=c.dtype)
    # A number of all joints is a literal, for the compiler to fold; others are tables.
    rows = {f"k_{name}": leaf[0] for name, leaf in plan.leaves().items()}
    read = [f"{name}[j]" if np.ptp(row) else c.number(row[0]) for name, row in rows.items()]
    read += [c.number(literal) for literal in traced.literals]
    state = [f"state->{name}[j]" for name in ("knots", "rates", "weights")]
    state += ["join", "knot", "end", "now", "starved"]
    if like.guard is not None:
        state += [f"state->{name}[j]" for name in GuardState._fields]
    text = statements(c, traced, [*read, *state, *inputs], len(read), places)
    tables = [c.table(name, row) for name, row in rows.items() if f"{name}[" in text]
    # Times are read once: for a compiler, writes to the other arrays might change them.
    times = {"join": "join", "knot": "time"}
    tables += [
        f"  const {c.type} {name} = state->{field};\n"
        for name, field in times.items()
        if re.search(rf"\b{name}\b", text)
    ]
    return "".join(tables) + text
