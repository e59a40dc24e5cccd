"""C functions beside the law: a robot's rigid-body dynamics, and a plan.

Their text is in ``c_rigid_body.h`` and ``c_plan.h``. The curve of a plan and its limits are traced
from :mod:`batchpid.plan.sampling`; the rows of a chunk are blended by the same operations in the same
order. So samples are bit-identical. The last bits of the dynamics differ from NumPy's.
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
from batchpid.task_space.rigid_tree import RigidTree


def rigid_body(c: Dialect, tree: RigidTree) -> str:
    """Return the functions ``PREFIX_mass_matrix``, ``PREFIX_bias`` and ``PREFIX_gravity`` of a
    tree.
    """
    bodies = tree.bodies
    # A joint's rotation is linear in 1, sin q and 1 - cos q, so that three constant matrices a
    # joint are enough.
    rotations = {"turn": bodies.at_zero, "sine": bodies.sine, "cosine": bodies.cosine}
    above = _integers(c, "above", tree.body_parents)
    poses = above + "".join(
        c.table(f"k_{name}", leaf[:, :, :3].reshape(-1, 9)) for name, leaf in rotations.items()
    )
    poses += c.table("k_place", bodies.at_zero[..., 3]) + c.table("k_slide", bodies.slide[..., 3])
    poses += c.table("k_center", bodies.center) + c.table("k_tensor", bodies.tensor.reshape(-1, 9))
    poses += _integers(c, "slides", bodies.slides[:, 0])
    coupling = _integers(c, "leader", tree.coupling.leader)
    coupling += c.table("multiplier", tree.coupling.multiplier)
    fall = ", ".join(map(c.number, bodies.gravity.tolist()))
    masses = above + coupling + c.table("k_mass", bodies.mass[:, 0])
    masses += c.table("k_armature", np.asarray(tree.armature))
    masses += f"  static const {c.type} gravity[3] = {{{fall}}};\n"
    return c.translated("c_rigid_body.h", poses=poses, masses=masses, coupling=coupling)


def _integers(c: Dialect, name: str, values: object) -> str:
    numbers = ", ".join(str(int(value)) for value in np.asarray(values))
    return f"  static const int {name}[{c.size}] = {{{numbers}}};\n"


def plan_functions(c: Dialect, plan: Plan, functions: str) -> str:
    """Return the functions of a plan; ``functions`` is the text before them, whose helpers are not
    repeated.
    """
    p, t, n = c.prefix, c.type, c.size
    # The state of the plan is traced with the names of the fields in C.
    like = init(plan, np.zeros((1, c.joints), c.dtype))
    limits = () if like.guard is None else GuardState._fields
    held = [f"state->{name}[j]" for name in limits]
    places = {place: c.number(0.0) if "rate" in place else "qpos[j]" for place in held}

    def curve_step(k: Plan, state: PlanState, inputs: list[Array]) -> list[Array]:
        return list(curve(k, state, *inputs)[:2])

    def sample_step(k: Plan, state: PlanState, inputs: list[Array]) -> list[Array]:
        state, setpoint, rate, _ = advance(k, state, *inputs)
        return [*leaves(state.guard), setpoint, rate]

    def blend_step(k: Plan, state: PlanState, inputs: list[Array]) -> list[Array]:
        return list(blend(k, state, *inputs))

    outputs = ["setpoint[j]", "rate[j]"]
    inputs = [f"chunk[k * {n} + j]", "begin", "offset[j]", "slope[j]", "first", "step", "rows"]
    text = c.translated(
        "c_plan.h",
        fields="".join(f"  {t} {name}[{n}];\n" for name in limits),
        starts="".join(f"    {place} = {start};\n" for place, start in places.items()),
        step=f"  const {t} dt = {p}_max(t - state->now, {c.number(LEAST_STEP)});\n",
        period=f"  const {t} period = {c.number(float(plan.period[0, 0]))}, now = state->now;\n",
        curve=_body(c, plan, like, curve_step, ["t"], outputs),
        sample=_body(c, plan, like, sample_step, ["t", "dt"], [*held, *outputs]),
        blend=_body(c, plan, like, blend_step, inputs, ["blended[k][j]", "weights[k][j]"]),
    )
    helped = "".join(helper for helper in helpers(c, text) if helper not in functions)
    horizon, knots = f"{p.upper()}_HORIZON", f"{p.upper()}_KNOTS"
    sizes = f"{horizon} = {plan.horizon}, {knots} = {plan.horizon + SPARE_ROWS}"
    return f"{helped}\nenum {{ {sizes} }};\n\n{text}"


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
