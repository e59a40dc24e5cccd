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
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Document
from batchpid.arrays.choices import MeasuredRate
from batchpid.checks.validate import choice, instance, names, time_step
from batchpid.errors import InvalidArgumentError
from batchpid.export.c_rigid_body import rigid_body
from batchpid.export.c_step import Dialect, Value, helpers, statements
from batchpid.export.differences import Exported, check_one_env
from batchpid.law import pid
from batchpid.law.coefficients import Coefficients, discretise
from batchpid.law.computed_torque import advance_with_mass_matrix, check_gain_units
from batchpid.law.params import PIDParams
from batchpid.law.state import PIDState
from batchpid.motors import guard as guard_model
from batchpid.motors.guard import Guard, GuardState
from batchpid.native.symbols import Symbol
from batchpid.native.tracing import trace
from batchpid.task_space.rigid_tree import RigidTree

RATES = {
    "measurement_rate": "measured velocity [rad/s or m/s]",
    "setpoint_rate": "rate of the setpoint [rad/s or m/s]",
    "feedforward": "effort added before saturation [N m or N]",
}
"""Optional inputs of a step."""


def to_c(
    params: PIDParams,
    dt: float,
    *,
    joint_names: Sequence[str] | None = None,
    guard: Guard | None = None,
    inputs: Sequence[str] | None = None,
    prefix: str = "batchpid",
    tree: RigidTree | None = None,
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
        Optional inputs of a step, of :data:`RATES`. Default: the feedforward, and the measured
        velocity if the params ask for it.
    prefix
        Beginning of every name in the header, for several controllers in one program.
    tree
        Of the robot (:meth:`batchpid.sim.Robot.kinematic_tree`): adds ``PREFIX_mass_matrix``,
        ``PREFIX_bias`` and ``PREFIX_gravity``.

    Raises
    ------
    InvalidArgumentError
        Params for several envs, options that exclude each other, names that C does not allow, or a
        tree with other joints.
    """
    return Exported(Header(params, dt, joint_names, guard, inputs, prefix, tree).text())


class Header:
    """Text of a header, from the trace of one step. Parameters and errors are as in
    :func:`to_c`.
    """

    def __init__(
        self,
        params: PIDParams,
        dt: float,
        joint_names: Sequence[str] | None,
        guard: Guard | None,
        inputs: Sequence[str] | None,
        prefix: str,
        tree: RigidTree | None,
    ) -> None:
        check_one_env(params)
        time_step("dt", dt)
        joints = params.num_joints
        unnamed = [f"joint {at}" for at in range(joints)]
        labels = unnamed if joint_names is None else names("joint_names", joint_names, joints)
        if not re.fullmatch(r"[A-Za-z_]\w*", prefix, re.ASCII):
            remedy = "use letters, digits and _"
            raise InvalidArgumentError(
                "prefix", "cannot be a name in C", value=prefix, remedy=remedy
            )
        params.check(1, labels)
        check_gain_units(params)
        if guard is not None:
            guard.check(1, labels)
        measures = isinstance(params.measurement_rate, MeasuredRate)
        if inputs is None:
            inputs = ("measurement_rate", "feedforward") if measures else ("feedforward",)
        chosen = {choice("inputs", each, RATES) for each in inputs}
        if measures and "measurement_rate" not in chosen:
            remedy = "add it, or use params.replace(measurement_rate='difference')"
            raise InvalidArgumentError(
                "inputs", "lack measurement_rate, which the params use", remedy=remedy
            )
        if tree is not None:
            instance("tree", tree, RigidTree, "use robot.kinematic_tree()")
            if list(tree.joint_names) != list(labels):
                problem = f"has the joints {', '.join(tree.joint_names)}, not {', '.join(labels)}"
                raise InvalidArgumentError(
                    "tree", problem, remedy="pass joint_names=, in the tree's order"
                )
        self.params = params
        self.dt = float(dt)
        self.guard = guard
        self.tree = tree
        self.labels = labels
        self.names = Dialect(prefix, np.dtype(params.dtype), joints)
        rates = [each for each in RATES if each in chosen]
        matrix = [] if params.gain_units is None else ["mass_matrix"]
        self.given = ["setpoint", "measurement", *rates, *matrix]
        """Inputs of a step, in their order."""
        # init runs on a measurement of NaN: what is NaN afterwards is a copy of the measurement.
        nan = np.full((1, joints), math.nan, params.dtype)
        started: Document = pid.init(params, nan).leaves()
        if guard is not None:
            started |= {"guarded_setpoint": nan, "guarded_rate": 0 * np.ones_like(nan)}
        self.started = started
        """State after init; NaN where it is the measurement."""

    def text(self) -> str:
        """Return the header."""
        k = discretise(self.params, self.dt)
        limits = self.guard if self.guard is not None else Guard()
        constants = [leaf for leaf in (*k, *limits) if isinstance(leaf, np.ndarray)]
        labels = [f"k_{name}" for name, leaf in k._asdict().items() if isinstance(leaf, np.ndarray)]
        labels += [f"guard_{name}" for name, leaf in limits._asdict().items() if leaf is not None]
        given, kept = self.given, list[str]()

        def step(*symbols: Symbol) -> list[Any]:
            rest = iter(symbols)
            law, limit = (
                [next(rest) if isinstance(x, np.ndarray) else x for x in leaves]
                for leaves in (k, limits)
            )
            state = {name: next(rest) for name in self.started}
            new, effort = self._step(
                Coefficients(*law), Guard(*limit), state, dict(zip(given, rest, strict=True))
            )
            kept[:] = new
            return [*new.values(), effort]

        traced = trace(step, len(constants), len(self.started) + len(given), self.params.dtype)
        values = [Value(f"{label}[j]", label) for label in labels]
        values += [Value(self.names.number(each)) for each in traced.literals]
        read = [Value(f"state->{name}[j]", f"state->{name}") for name in self.started]
        read += [Value(f"{name}[j]", name) for name in given]
        results = [*(f"state->{name}[j]" for name in kept), "effort[j]"]
        body = "".join(statements(self.names, traced, values, read, results))
        used = [at for at, label in enumerate(labels) if re.search(rf"\b{label}\b", body)]
        tables = "".join(self.names.table(labels[at], constants[at][0]) for at in used)
        return self._frame(tables + body, body)

    def _step(
        self, k: Coefficients, guard: Guard, state: Document, given: Document
    ) -> tuple[Any, Any]:
        """Return the new state, by name, and the effort: the control step of one robot."""
        new: Document = {}
        setpoint, rate = given["setpoint"], given.get("setpoint_rate")
        if self.guard is not None:
            before = GuardState(state["guarded_setpoint"], state["guarded_rate"])
            after, changed = guard_model.advance(guard, before, setpoint, self.dt)
            new = {"guarded_setpoint": after.setpoint, "guarded_rate": after.rate}
            setpoint, xp = after.setpoint, setpoint.__array_namespace__()
            rate = None if rate is None else xp.where(changed, after.rate, rate)
        arguments = (
            PIDState(**{name: leaf for name, leaf in state.items() if name in PIDState._fields}),
            setpoint,
            given["measurement"],
        )
        optional = given.get("measurement_rate"), rate, given.get("feedforward")
        if "mass_matrix" in given:
            law, terms = advance_with_mass_matrix(k, *arguments, given["mass_matrix"], *optional)
        else:
            law, terms = pid.advance(k, *arguments, *optional)
        return {**law.leaves(), **new}, terms.effort

    def extent(self, name: str) -> str:
        """Return the number of entries of an input."""
        return (
            f"{self.names.size} * {self.names.size}" if name == "mass_matrix" else self.names.size
        )

    def _frame(self, code: str, body: str) -> str:
        """Return the whole header around the code of a step."""
        p = self.names.prefix
        t = self.names.type
        n = self.names.size
        given = self.given
        units = {
            "setpoint": "r [rad or m]",
            "measurement": "y [rad or m]",
            "mass_matrix": "M at about y [kg m^2 or kg], by rows",
            **RATES,
        }
        arguments = "".join(
            f",\n    const {t} {name}[{self.extent(name)}] /* {units[name]} */" for name in given
        )
        functions = "".join(helpers(self.names, body))
        functions += "" if self.tree is None else rigid_body(self.names, self.tree)
        passed = "".join(f", {name}" for name in given)
        pointers = "".join(f"const {t} *{name}, " for name in given)
        fields = "".join(f"  {t} {name}[{n}];\n" for name in self.started) or "  char unused;\n"
        every, kept = (
            self._started(self.started),
            self._started({k: v for k, v in self.started.items() if k != "integral"}),
        )
        names = ["state", *given]
        unused = "".join(
            f"  (void){name};\n" for name in names if not re.search(rf"\b{name}\b", body)
        )
        joints = (
            "".join(f" *   {at}: {label}\n" for at, label in enumerate(self.labels))
            .replace("*/", "* /")
            .replace("/*", "/ *")
        )
        return f"""/* PID control of one robot, generated by batchpid. Do not edit.
 *
 * Call {p}_init once at the first measurement, then {p}_step every {self.dt!r} s; {p}_reset restarts
 * the law and keeps what the integral has learnt. The functions allocate nothing and share nothing. Compile with
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

enum {{ {n} = {self.names.joints} }};

/* Memory of the law between steps. */
typedef struct {{
{fields}}} {p}_state;

{functions}/* Start at rest at a measurement. */
static inline void {p}_init({p}_state *state, const {t} measurement[{n}]) {{
{every}}}

/* Restart from a measurement; the integral is kept. */
static inline void {p}_reset({p}_state *state, const {t} measurement[{n}]) {{
{kept}}}

/* Advance the law by one time step and write the efforts [N m or N]. */
static inline void {p}_step(
    {p}_state *state{arguments},
    {t} effort[{n}]) {{
{code}{unused}}}

#ifdef __cplusplus
}}

/* The law and its state as an object. */
class {p}_controller {{
 public:
  explicit {p}_controller(const {t} *measurement) {{ {p}_init(&state_, measurement); }}
  void reset(const {t} *measurement) {{ {p}_reset(&state_, measurement); }}
  void step({pointers}{t} *effort) {{ {p}_step(&state_{passed}, effort); }}

 private:
  {p}_state state_;
}};
#endif
#endif
"""

    def _started(self, leaves: Document) -> str:
        """Return the statements that start ``leaves`` of the state."""
        lines = []
        for name, leaf in leaves.items():
            numbers = [
                None if math.isnan(each) else self.names.number(each) for each in leaf[0].tolist()
            ]
            if len(set(numbers)) == 1:
                lines.append(f"    state->{name}[j] = {numbers[0] or 'measurement[j]'};\n")
            else:
                table = ", ".join(map(str, numbers))
                lines.append(
                    f"    static const {self.names.type} {name}[{self.names.size}] = {{{table}}};\n"
                )
                lines.append(f"    state->{name}[j] = {name}[j];\n")
        loop = (
            f"  for (int j = 0; j < {self.names.size}; ++j) {{\n{''.join(lines)}  }}\n"
            if lines
            else ""
        )
        return f"{loop}  (void)state;\n  (void)measurement;\n"
