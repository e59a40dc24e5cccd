"""The control law as a C99 header without dependencies, generated from the trace of
:func:`batchpid.advance`.

The header holds the gains as constants, a struct for the state, and three functions:
``PREFIX_init``, ``PREFIX_reset`` and ``PREFIX_step``. They allocate nothing and have no global
state. Each operation is the same as in NumPy, in the same order, so that the efforts are
bit-identical under ``-ffp-contract=off``, which forbids the compiler to fuse a multiplication and
an addition. It also compiles as C++.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

import numpy as np

from batchpid.arrays.array_types import Array, Document
from batchpid.arrays.elementwise import namespace
from batchpid.arrays.trees import is_leaf, leaves, parts, structure
from batchpid.checks import choice, instance, names, time_step
from batchpid.errors import InvalidArgumentError
from batchpid.export.c_step import Dialect, comment, helpers, plan_functions, rigid_body, statements
from batchpid.export.differences import Exported, check_one_env
from batchpid.law import pid
from batchpid.law.coefficients import Coefficients, discretise
from batchpid.law.computed_torque import advance_with_mass_matrix, check_gain_units
from batchpid.law.params import PIDParams
from batchpid.law.state import PIDState
from batchpid.motors import guard as guard_model
from batchpid.motors.guard import Guard, GuardState
from batchpid.native.tracing import trace_trees
from batchpid.plan import Plan
from batchpid.task_space.rigid_tree import RigidTree

RATES = {
    "measurement_rate": "measured velocity [rad/s or m/s]",
    "setpoint_rate": "rate of the setpoint [rad/s or m/s]",
    "feedforward": "effort added before saturation [N m or N]",
}
"""Optional inputs of a step."""

TREE = "use robot.kinematic_tree()"

NO_ACCELERATION = (
    "plan: its acceleration is no input of the law; add M(q) times the change of the rate per second"
    " to the feedforward"
)
"""Difference of a header with a plan from a Runner."""


def to_c(
    params: PIDParams,
    dt: float,
    *,
    joint_names: Sequence[str] | None = None,
    guard: Guard | None = None,
    inputs: Sequence[str] = ("feedforward",),
    prefix: str = "batchpid",
    tree: RigidTree | None = None,
    plan: Plan | None = None,
) -> Exported:
    """Return a C header with the law of one robot; its numbers have the params' dtype.

    Parameters
    ----------
    params
        Of one env: (1, joints). Gains per "mass_matrix" add an argument ``mass_matrix`` (joints,
        joints), by rows.
    dt
        Time step of the control [s].
    joint_names
        Named in the comments.
    guard
        Limits of the setpoint, applied before the law.
    inputs
        Optional inputs of a step, of :data:`RATES`; beside them the measured velocity if the params
        ask for it, and the rate of the setpoint with a plan.
    prefix
        Beginning of every name in the header, for several controllers in one program.
    tree
        Of the robot (:meth:`batchpid.sim.Robot.kinematic_tree`): adds ``PREFIX_mass_matrix``,
        ``PREFIX_bias`` and ``PREFIX_gravity``.
    plan
        Of one env, in the params' dtype: adds ``PREFIX_plan_init``, ``PREFIX_add_chunk`` and
        ``PREFIX_sample``.

    Raises
    ------
    InvalidArgumentError
        Params for several envs, options that exclude each other, names that C does not allow, or a
        tree with other joints.
    """
    check_one_env(params)
    dt = time_step("dt", dt)
    joints = [f"joint {at}" for at in range(params.num_joints)]
    if joint_names is not None:
        joints = names("joint_names", joint_names, params.num_joints)
    if not re.fullmatch(r"[A-Za-z_]\w*", prefix, re.ASCII):
        problem = "cannot be a name in C"
        remedy = "use letters, digits and _"
        raise InvalidArgumentError("prefix", problem, value=prefix, remedy=remedy)
    check_gain_units(params)
    # All parts have to belong to the same joints, in the same order.
    for part in (params, guard, plan):
        if part is not None:
            part.check(1, joints)
    if tree is not None and list(instance("tree", tree, RigidTree, TREE).joint_names) != joints:
        problem = f"has the joints {', '.join(tree.joint_names)}, not {', '.join(joints)}"
        remedy = "pass joint_names=, in the tree's order"
        raise InvalidArgumentError("tree", problem, remedy=remedy)
    if plan is not None and plan.dtype != params.dtype:
        problem = f"is {plan.dtype}, but the params are {params.dtype}"
        raise InvalidArgumentError("plan", problem, remedy="use one dtype")
    c = Dialect(prefix, np.dtype(params.dtype), len(joints))
    arguments = ["setpoint", "measurement", *_optional(params, inputs, plan)]
    if params.gain_units is not None:
        arguments.append("mass_matrix")
    # init runs on a measurement of NaN: an entry that is NaN afterwards copies the measurement.
    nan = np.full((1, len(joints)), math.nan, params.dtype)
    state = pid.init(params, nan), None if guard is None else guard_model.init(guard, nan)
    fields = state[0].leaves()
    if state[1] is not None:
        fields |= {f"guarded_{name}": leaf for name, leaf in state[1]._asdict().items()}
    code = _step_code(
        c,
        (discretise(params, dt), guard or Guard()),
        state,
        arguments,
        dt,
        list(fields),
    )
    functions = "".join(helpers(c, code))
    if tree is not None:
        functions += rigid_body(c, tree)
    if plan is not None:
        functions += plan_functions(c, plan, functions)
    listed = "".join(f" *   {at}: {comment(joint)}\n" for at, joint in enumerate(joints))
    text = _frame(
        c,
        f"every {dt!r} s",
        listed,
        functions,
        fields,
        arguments,
        code,
    )
    return Exported(text, () if plan is None else (NO_ACCELERATION,))


def _optional(params: PIDParams, inputs: Sequence[str], plan: Plan | None) -> list[str]:
    """Return the optional inputs of a step, in the order of RATES."""
    chosen = {choice("inputs", name, RATES) for name in inputs}
    if params.measurement_rate is not None:
        chosen.add("measurement_rate")
    if plan is not None:
        chosen.add("setpoint_rate")
    return [name for name in RATES if name in chosen]


def _step_code(
    c: Dialect,
    constants: tuple[Coefficients, Guard],
    state: tuple[PIDState, GuardState | None],
    arguments: list[str],
    dt: float,
    fields: list[str],
) -> str:
    """Return the statements of a step, which is traced once, with placeholders for everything that
    is not a constant.
    """

    def step(
        constants: tuple[Coefficients, Guard],
        state: tuple[PIDState, GuardState | None],
        inputs: Sequence[Array],
    ) -> list[Array]:
        """Return the leaves of the new state, and the effort: the control step of one robot."""
        k, limits = constants
        law, held = state
        named = dict(zip(arguments, inputs, strict=True))
        setpoint = named["setpoint"]
        rate = named.get("setpoint_rate")
        # The guard comes before the law, as in a Runner.
        if held is not None:
            held, changed = guard_model.advance(limits, held, setpoint, dt)
            setpoint = held.setpoint
            if rate is not None:
                rate = namespace(rate).where(changed, held.rate, rate)
        rates = named.get("measurement_rate"), rate
        measurement, feedforward = named["measurement"], named.get("feedforward")
        if "mass_matrix" in named:
            law, terms = advance_with_mass_matrix(
                k,
                law,
                setpoint,
                measurement,
                named["mass_matrix"],
                *rates,
                None,
                feedforward,
            )
        else:
            law, terms = pid.advance(k, law, setpoint, measurement, *rates, feedforward)
        return [*leaves((law, held)), terms.effort]

    trees = constants, state, (...,) * len(arguments)
    traced = trace_trees(step, *map(structure, trees), dtype=c.dtype)
    k, limits = constants
    labels = [f"k_{name}" for name, leaf in parts(k).items() if is_leaf(leaf)]
    labels += [f"guard_{name}" for name in limits.leaves()]
    read = [f"{label}[j]" for label in labels]
    read += [c.number(literal) for literal in traced.literals]
    places = [f"state->{name}[j]" for name in fields]
    inputs = [f"{name}[j]" for name in arguments]
    body = statements(c, traced, [*read, *places, *inputs], len(read), [*places, "effort[j]"])
    # Constants that no statement names would be warnings of the compiler, as inputs without effect.
    tables = [
        c.table(label, leaf[0])
        for label, leaf in zip(labels, leaves(constants), strict=True)
        if re.search(rf"\b{label}\b", body)
    ]
    unused = [
        f"  (void){name};\n"
        for name in ("state", *arguments)
        if not re.search(rf"\b{name}\b", body)
    ]
    return "".join([*tables, body, *unused])


def _frame(
    c: Dialect,
    period: str,
    joints: str,
    functions: str,
    state: Document,
    inputs: list[str],
    code: str,
) -> str:
    """Return the whole header around the ``code`` of a step and further ``functions``."""
    p = c.prefix
    t = c.type
    n = c.size
    units = {
        "setpoint": "r [rad or m]",
        "measurement": "y [rad or m]",
        "mass_matrix": "M at about y [kg m^2 or kg], by rows",
        **RATES,
    }
    sizes = {"mass_matrix": f"{n} * {n}"}
    arguments = "".join(
        f",\n    const {t} {name}[{sizes.get(name, n)}] /* {units[name]} */" for name in inputs
    )
    fields = "".join(f"  {t} {name}[{n}];\n" for name in state) or "  char unused;\n"
    # A restart keeps the integral; a start sets it to 0, within its limits.
    every = _started(c, state)
    lasting = _started(c, {name: leaf for name, leaf in state.items() if name != "integral"})
    return f"""/* PID control of one robot, generated by batchpid. Do not edit.
 *
 * Call {p}_init once at the first measurement, then {p}_step {period}; {p}_reset restarts
 * the law and keeps the integral. The functions allocate no memory and share no state. Compile with
 * -ffp-contract=off for efforts that are bit-identical to batchpid's.
 *
 * Joints:
{joints} */

#ifndef {p.upper()}_H
#define {p.upper()}_H

#include <math.h>

#ifdef __cplusplus
extern "C" {{
#endif

enum {{ {n} = {c.joints} }};

/* Memory of the law between steps. */
typedef struct {{
{fields}}} {p}_state;

{functions}/* Start at rest at a measurement. */
static inline void {p}_init({p}_state *state, const {t} measurement[{n}]) {{
{every}}}

/* Restart from a measurement; the integral is kept. */
static inline void {p}_reset({p}_state *state, const {t} measurement[{n}]) {{
{lasting}}}

/* Advance the law by one time step and write the efforts [N m or N]. */
static inline void {p}_step(
    {p}_state *state{arguments},
    {t} effort[{n}]) {{
{code}}}

#ifdef __cplusplus
}}
#endif
#endif
"""


def _started(c: Dialect, leaves: Document) -> str:
    """Return the statements that start ``leaves`` of the state."""
    unused = "  (void)state;\n  (void)measurement;\n"
    lines = []
    for name, leaf in leaves.items():
        # NaN marks an entry that starts at the measurement. Equal numbers are written once.
        numbers = [
            "measurement[j]" if math.isnan(number) else c.number(number)
            for number in leaf[0].tolist()
        ]
        value = numbers[0]
        if len(set(numbers)) > 1:
            value = f"{name}[j]"
            lines.append(f"  {c.table(name, leaf[0])}")
        lines.append(f"    state->{name}[j] = {value};\n")
    if lines:
        return "".join([c.loop, *lines, "  }\n", unused])
    return unused
