"""C functions beside the law: a robot's rigid-body dynamics, and a plan.

Their text is in ``c_rigid_body.h`` and ``c_plan.h``. The curve of a plan and its limits are traced
from :mod:`batchpid.plan.sampling`; the rows of a chunk are blended by the same operations in the same
order. So samples are bit-identical. The last bits of the dynamics differ from NumPy's.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

import numpy as np

from batchpid.arrays.array_types import Array, Pytree
from batchpid.arrays.trees import leaves, structure
from batchpid.export.c_step import Dialect, helpers, statements
from batchpid.motors.guard import GuardState
from batchpid.native.tracing import trace_trees
from batchpid.plan import sampling as model
from batchpid.plan.plans import SPARE_ROWS, Plan
from batchpid.plan.sampling import PlanState
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
    return c.translated(
        "c_rigid_body.h",
        poses=poses,
        masses=masses,
        coupling=coupling,
    )


def _integers(c: Dialect, name: str, values: object) -> str:
    numbers = ", ".join(str(int(value)) for value in np.asarray(values))
    return f"  static const int {name}[{c.size}] = {{{numbers}}};\n"


def plan_functions(c: Dialect, plan: Plan, functions: str) -> str:
    """Return the functions of a plan; ``functions`` is the text before them, whose helpers are not
    repeated.
    """
    p, t, n = c.prefix, c.type, c.size
    like = model.init(plan, np.zeros((1, c.joints), c.dtype))
    limits = () if like.guard is None else GuardState._fields
    held = [f"state->{name}[j]" for name in limits]
    starts = {place: c.number(0.0) if "rate" in place else "qpos[j]" for place in held}
    segment = [f"state->segment[{i}][j]" for i in range(4)]
    # Leaves of the state by the names that they have in C.
    tables = ("knots", "rates", "weights")[: 2 if like.weights is None else 3]
    names = [f"state->{name}[j]" for name in tables]
    names += ["begin0", "last0", *segment, "end0", "now0", "starved0", *held]

    def sampled(k: Plan, state: PlanState, t: Array, dt: Array) -> Pytree:
        state, setpoint, rate, _ = model.advance(k, state, t, dt)
        return state.guard, setpoint, rate

    def present(k: Plan, state: PlanState) -> Pytree:
        return model.evaluate(state.segment, state.now - state.end)[:2]

    def joined(k: Plan, _: PlanState, *knots: Array) -> Pytree:
        return model.cubic(k, *knots)

    def blended(k: Plan, state: PlanState, *row: Array) -> Pytree:
        position, weight = model.blend(k, state, *row)
        return position, row[0] * 0.0 if weight is None else weight

    def body(step: Callable[..., Pytree], inputs: list[str], *places: str) -> str:
        return _body(
            c,
            step,
            plan,
            like,
            [*names, *inputs],
            len(inputs),
            places,
        )

    row = [f"chunk[k * {n} + j]", "begin", "offset[j]", "slope[j]", "first", "step", "rows"]
    knots = ["length", "position[j]", "blended[f][j]", "speed[j]", "state->rates[j][f]"]
    text = c.translated(
        "c_plan.h",
        fields="".join(f"  {t} {name}[{n}];\n" for name in limits),
        starts="".join(f"    {place} = {start};\n" for place, start in starts.items()),
        step=f"  const {t} dt = {p}_max(t - state->now, {c.number(model.LEAST_STEP)});\n",
        period=f"  const {t} period = {c.number(float(plan.period[0, 0]))}, now = state->now;\n",
        renewed=body(model.segment_at, ["t"], "state->end", *segment),
        sampled=body(sampled, ["t", "dt"], *held, "setpoint[j]", "rate[j]"),
        present=body(present, [], "position[j]", "speed[j]"),
        later=body(model.curve, ["joined"], "offset[j]", "slope[j]"),
        blended=body(blended, row, "blended[k][j]", "weights[k][j]"),
        joined=body(joined, knots, *segment),
    )
    helped = "".join(helper for helper in helpers(c, text) if helper not in functions)
    horizon, rows = f"{p.upper()}_HORIZON", f"{p.upper()}_KNOTS"
    sizes = f"{horizon} = {plan.horizon}, {rows} = {plan.horizon + SPARE_ROWS}"
    return f"{helped}\nenum {{ {sizes} }};\n\n{text}"


def _body(
    c: Dialect,
    step: Callable[..., Pytree],
    plan: Plan,
    like: PlanState,
    names: list[str],
    inputs: int,
    places: Sequence[str],
) -> str:
    """Return the statements of ``step(plan, state, *inputs)``, a block.

    ``names`` are expressions of the leaves of the state and the ``inputs``; results are written to
    ``places``.
    """

    def flat(k: Plan, state: PlanState, given: tuple[Array, ...]) -> list[Array]:
        return leaves(step(k, state, *given))

    trees = map(structure, (plan, like, (...,) * inputs))
    traced = trace_trees(flat, *trees, dtype=c.dtype)
    # A number of all joints is a literal, for the compiler to fold; others are tables.
    rows = {f"k_{name}": leaf[0] for name, leaf in plan.leaves().items()}
    read = [f"{name}[j]" if np.ptp(row) else c.number(row[0]) for name, row in rows.items()]
    read += [c.number(literal) for literal in traced.literals]
    text = statements(c, traced, [*read, *names], len(read), list(places))
    tables = [c.table(name, row) for name, row in rows.items() if f"{name}[" in text]
    # Times are read once: for a compiler, writes to the other arrays might change them.
    tables += [
        f"  const {c.type} {name}0 = state->{name};\n"
        for name in ("begin", "last", "end", "now", "starved")
        if re.search(rf"\b{name}0\b", text)
    ]
    return "".join(["  {\n", *tables, text, "  }\n"])
