"""The control law as a C99 header without dependencies, generated from the trace of :func:`batchpid.advance`.

The header holds the gains as constants, a struct for the state, and three functions: ``PREFIX_init``, ``PREFIX_reset``
and ``PREFIX_step``. They allocate nothing and have no global state. Each operation is the same as in NumPy, in the
same order, so that the efforts are bit-identical under ``-ffp-contract=off``, which forbids the compiler to fuse a
multiplication and an addition. It also compiles as C++.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from batchpid.arrays.choices import MeasuredRate, PerInertia, PerMassMatrix
from batchpid.checks.validate import choice, instance, names, positive
from batchpid.errors import InvalidArgumentError
from batchpid.export.exported import Exported
from batchpid.law import pid
from batchpid.law.coefficients import Coefficients, discretise
from batchpid.law.computed_torque import advance_with_mass_matrix, check_gain_units, per_inertia
from batchpid.law.params import PIDParams
from batchpid.law.state import PIDState
from batchpid.motors import guard as guard_model
from batchpid.motors.guard import Guard, GuardState, check_guard
from batchpid.native.operations import OPERATIONS
from batchpid.native.tracing import Symbol, Trace, trace

RATES = {
    "measurement_rate": "measured velocity [rad/s or m/s]",
    "setpoint_rate": "rate of the setpoint [rad/s or m/s]",
    "feedforward": "effort added before saturation [N m or N]",
}
"""Optional inputs of a step."""
_EXPRESSIONS = {
    **dict.fromkeys(("multiply", "and"), "{0} * {1}"),
    **dict.fromkeys(("maximum", "or"), "{p}_max({0}, {1})"),
    "add": "{0} + {1}",
    "subtract": "{0} - {1}",
    "divide": "{0} / {1}",
    "minimum": "{p}_min({0}, {1})",
    "greater": "{0} > {1} ? {one} : {zero}",
    "greater_equal": "{0} >= {1} ? {one} : {zero}",
    "less": "{0} < {1} ? {one} : {zero}",
    "less_equal": "{0} <= {1} ? {one} : {zero}",
    "equal": "{0} == {1} ? {one} : {zero}",
    "not_equal": "{0} != {1} ? {one} : {zero}",
    "not": "{one} - {0}",
    "negative": "-({0})",
    "absolute": "fabs{f}({0})",
    "rint": "rint{f}({0})",
    "ceil": "ceil{f}({0})",
    "floor": "floor{f}({0})",
    "sqrt": "sqrt{f}({0})",
    "sign": "{0} > {zero} ? {one} : {0} < {zero} ? -{one} : {0}",
    "isfinite": "{0} - {0} == {zero} ? {one} : {zero}",
    "where": "{0} != {zero} ? {1} : {2}",
    "multiply_add": "{0} * {1} + {2}",
    "add_subtract": "{0} + {1} - {2}",
    "subtract_multiply": "({0} - {1}) * {2}",
    "clip": "{p}_min({p}_max({0}, {1}), {2})",
}
"""Elementwise operations in C. A mask is 1 or 0. A NaN propagates through max and min, as in NumPy."""
_ACROSS = ("row_minimum", "matrix_vector")
"""Operations that combine the joints."""


def to_c(
    params: PIDParams,
    dt: float,
    *,
    joint_names: Sequence[str] | None = None,
    guard: Guard | None = None,
    inputs: Sequence[str] | None = None,
    prefix: str = "batchpid",
) -> Exported:
    """Return a C header with the law of one robot; its numbers have the params' dtype.

    Parameters
    ----------
    params
        Of one env: (1, joints). Gains per "inertia" add an argument ``inertia`` (joints,), gains per "mass_matrix" an
        argument ``mass_matrix`` (joints, joints), by rows.
    dt
        Time step of the control [s].
    joint_names
        Named in the comments.
    guard
        Limits of the setpoint, applied before the law.
    inputs
        Optional inputs of a step, of :data:`RATES`. Default: the feedforward, and the measured velocity if the params
        ask for it.
    prefix
        Beginning of every name in the header, for several controllers in one program.

    Raises
    ------
    InvalidArgumentError
        Params for several envs, options that exclude each other, or names that C does not allow.
    """
    instance("params", params, PIDParams, "build them with make_params()")
    positive("dt", dt, "s")
    joints = params.num_joints
    if params.num_envs > 1:
        remedy = "choose one env: params.for_envs(slice(k, k + 1))"
        raise InvalidArgumentError("params", f"are for {params.num_envs} envs", remedy=remedy)
    labels = (
        [f"joint {at}" for at in range(joints)] if joint_names is None else names("joint_names", joint_names, joints)
    )
    if not re.fullmatch(r"[A-Za-z_]\w*", prefix, re.ASCII):
        raise InvalidArgumentError("prefix", "is no name in C", value=prefix, remedy="use letters, digits and _")
    params.check(1, labels)
    check_gain_units(params)
    if guard is not None:
        check_guard(guard, 1, labels)
    measures = isinstance(params.measurement_rate, MeasuredRate)
    if inputs is None:
        inputs = ("measurement_rate", "feedforward") if measures else ("feedforward",)
    chosen = {choice("inputs", each, RATES) for each in inputs}
    if measures and "measurement_rate" not in chosen:
        remedy = "add it, or use params.replace(measurement_rate='difference')"
        raise InvalidArgumentError("inputs", "lack measurement_rate, which the params use", remedy=remedy)
    return Exported(
        _Header(params, float(dt), guard, [each for each in RATES if each in chosen], prefix, labels).text()
    )


class _Value(NamedTuple):
    """Value of the law for each joint: an expression for joint ``j``, and whether it is an array of temporaries."""

    text: str
    array: str | None = None
    """Name of the array, for operations across joints."""


class _Header:
    """Text of a header, from the trace of one step."""

    def __init__(
        self, params: PIDParams, dt: float, guard: Guard | None, inputs: list[str], prefix: str, labels: list[str]
    ) -> None:
        self.params, self.dt, self.guard, self.inputs, self.prefix = params, dt, guard, inputs, prefix
        self.labels, self.joints = labels, params.num_joints
        single = params.dtype == np.float32
        self.type, self.suffix = ("float", "f") if single else ("double", "")
        whole, diagonal = (isinstance(params.gain_units, kind) for kind in (PerMassMatrix, PerInertia))
        self.matrix = "mass_matrix" if whole else "inertia" if diagonal else None
        nan = np.full((1, self.joints), math.nan, params.dtype)
        started: dict[str, Any] = pid.init(params, nan).leaves()
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
        given = ["setpoint", "measurement", *self.inputs, *([self.matrix] if self.matrix else [])]
        kept: list[str] = []

        def step(*symbols: Symbol) -> list[Any]:
            rest = iter(symbols)
            law, limit = ([next(rest) if isinstance(x, np.ndarray) else x for x in leaves] for leaves in (k, limits))
            state = {name: next(rest) for name in self.started}
            new, effort = self._step(Coefficients(*law), Guard(*limit), state, dict(zip(given, rest, strict=True)))
            kept[:] = new
            return [*new.values(), effort]

        traced = trace(step, len(constants), len(self.started) + len(given), self.params.dtype)
        values = [_Value(f"{label}[j]", label) for label in labels]
        values += [_Value(self._number(each)) for each in traced.literals]
        read = [_Value(f"state->{name}[j]", f"state->{name}") for name in self.started]
        read += [_Value(f"{name}[j]", name) for name in given]
        body = "".join(self._body(traced, values, read, [*(f"state->{name}[j]" for name in kept), "effort[j]"]))
        used = [at for at, label in enumerate(labels) if re.search(rf"\b{label}\b", body)]
        tables = "".join(self._table(labels[at], constants[at]) for at in used)
        return self._frame(given, tables + body, body)

    def _step(self, k: Coefficients, guard: Guard, state: dict[str, Any], given: dict[str, Any]) -> tuple[Any, Any]:
        """Return the new state, by name, and the effort: the control step of one robot."""
        new: dict[str, Any] = {}
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
        if self.matrix == "mass_matrix":
            law, effort = advance_with_mass_matrix(k, *arguments, given["mass_matrix"], *optional)
        else:
            k = k if self.matrix is None else per_inertia(k, given["inertia"])
            law, effort = pid.advance(k, *arguments, *optional)
        return {**law.leaves(), **new}, effort

    def _body(self, traced: Trace, constants: list[_Value], read: list[_Value], results: list[str]) -> Iterator[str]:
        """Yield the statements of a step: loops over the joints, with the operations across joints between them."""
        operations, ends = _unrolled(traced, len(constants), len(read))
        values = dict(enumerate([*constants, *read]))
        starts = [0, *(at for at, each in enumerate(operations) if each[0] in _ACROSS), len(operations)]
        loop_of = {each[1]: sum(start <= at for start in starts[1:]) for at, each in enumerate(operations)}
        last = len(starts) - 2
        shared = (
            {  # temporaries that a later loop or an operation across joints reads
                operand
                for at, (name, _, operands) in enumerate(operations)
                for operand in operands
                if operand in loop_of
                and (name in _ACROSS or loop_of[operand] < sum(start <= at for start in starts[1:]))
            }
            | {end for end in ends if loop_of.get(end, last) < last}
        )
        arrays = sorted(shared | {each[1] for each in operations if each[0] in _ACROSS})
        if arrays:
            yield f"  {self.type} {', '.join(f't{at}[{self._count()}]' for at in arrays)};\n"
        for loop, (start, stop) in enumerate(pairwise(starts)):
            first = operations[start] if start < stop else None
            if first is not None and first[0] in _ACROSS:
                yield self._across(first[0], f"t{first[1]}", [values[each] for each in first[2]])
                values[first[1]] = _Value(f"t{first[1]}[j]", f"t{first[1]}")
                start += 1
            if start == stop and loop < last:
                continue
            yield f"  for (int j = 0; j < {self._count()}; ++j) {{\n"
            for name, out, operands in operations[start:stop]:
                texts = [values[each].text for each in operands]
                keys = {"p": self.prefix, "f": self.suffix, "one": self._number(1.0), "zero": self._number(0.0)}
                target = f"t{out}[j]" if out in shared else f"const {self.type} t{out}"
                yield f"    {target} = {_EXPRESSIONS[name].format(*texts, **keys)};\n"
                values[out] = _Value(f"t{out}[j]", f"t{out}") if out in shared else _Value(f"t{out}")
            if loop == last:
                yield from self._stores(results, [values[end].text for end in ends])
            yield "  }\n"

    def _stores(self, places: list[str], texts: list[str]) -> Iterator[str]:
        """Yield the statements that write the results; the old state is read before it is overwritten."""
        for at, (place, text) in enumerate(zip(places, texts, strict=True)):
            if text.startswith("state->") and text != place:
                texts[at] = f"old{at}"
                yield f"    const {self.type} old{at} = {text};\n"
        yield from (f"    {place} = {text};\n" for place, text in zip(places, texts, strict=True) if place != text)

    def _across(self, name: str, out: str, operands: list[_Value]) -> str:
        """Return the call of an operation across joints."""
        return f"  {self.prefix}_{name}({', '.join(each.array or each.text for each in operands)}, {out});\n"

    def _frame(self, given: list[str], code: str, body: str) -> str:
        """Return the whole header around the code of a step."""
        p, t, n, guard_name = self.prefix, self.type, self._count(), f"{self.prefix.upper()}_H"
        units = {
            "setpoint": "r [rad or m]",
            "measurement": "y [rad or m]",
            "mass_matrix": "M at about y [kg m^2 or kg], by rows",
            "inertia": "diagonal of M at about y [kg m^2 or kg]",
            **RATES,
        }
        arguments = "".join(
            f",\n    const {t} {name}[{n}{f' * {n}' if name == 'mass_matrix' else ''}] /* {units[name]} */"
            for name in given
        )
        helpers = "".join(_helpers(p, t, n, self.suffix, body))
        fields = "".join(f"  {t} {name}[{n}];\n" for name in self.started) or "  char unused;\n"
        every, kept = (
            self._started(self.started),
            self._started({k: v for k, v in self.started.items() if k != "integral"}),
        )
        names = ["state", *given]
        unused = "".join(f"  (void){name};\n" for name in names if not re.search(rf"\b{name}\b", body))
        joints = "".join(f" *   {at}: {label}\n" for at, label in enumerate(self.labels)).replace("*/", "* /")
        return f"""/* PID control of one robot, generated by batchpid. Do not edit.
 *
 * Call {p}_init once at the first measurement, then {p}_step every {self.dt!r} s; {p}_reset restarts
 * the law and keeps what the integral has learnt. The functions allocate nothing and share nothing. Compile with
 * -ffp-contract=off for efforts that are bit-identical to batchpid's.
 *
 * Joints:
{joints} */

#ifndef {guard_name}
#define {guard_name}

#include <math.h>

#ifdef __cplusplus
extern "C" {{
#endif

enum {{ {n} = {self.joints} }};

/* Memory of the law between steps. */
typedef struct {{
{fields}}} {p}_state;

{helpers}/* Start at rest at a measurement. */
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
#endif
#endif
"""

    def _started(self, leaves: dict[str, Any]) -> str:
        """Return the statements that start ``leaves`` of the state."""
        lines = []
        for name, leaf in leaves.items():
            numbers = [None if math.isnan(each) else self._number(each) for each in leaf[0].tolist()]
            if len(set(numbers)) == 1:
                lines.append(f"    state->{name}[j] = {numbers[0] or 'measurement[j]'};\n")
            else:
                table = ", ".join(map(str, numbers))
                lines.append(f"    static const {self.type} {name}[{self._count()}] = {{{table}}};\n")
                lines.append(f"    state->{name}[j] = {name}[j];\n")
        loop = f"  for (int j = 0; j < {self._count()}; ++j) {{\n{''.join(lines)}  }}\n" if lines else ""
        return f"{loop}  (void)state;\n  (void)measurement;\n"

    def _table(self, name: str, leaf: Any) -> str:
        numbers = ", ".join(map(self._number, leaf[0].tolist()))
        return f"  static const {self.type} {name}[{self._count()}] = {{{numbers}}};\n"

    def _count(self) -> str:
        return f"{self.prefix.upper()}_JOINTS"

    def _number(self, value: float) -> str:
        """Return a number of the params' dtype as a literal that reads back as the same number."""
        if math.isinf(value):
            return "-INFINITY" if value < 0 else "INFINITY"
        return f"{np.dtype(self.params.dtype).type(value).item()!r}{self.suffix}"


def _unrolled(traced: Trace, constants: int, read: int) -> tuple[list[tuple[str, int, list[int]]], list[int]]:
    """Return the operations ``(name, value, operands)`` of a trace, each with a new value, and the values returned.

    The operations on constants come first. Values below ``constants + read`` are constants and inputs of a step.
    """
    operations: list[tuple[str, int, list[int]]] = []
    following = iter(range(constants + read, 10**9))

    def unroll(part: Trace, at: list[int]) -> list[int]:
        for code, out, *operands in np.frombuffer(part.operations, np.int32).reshape(-1, 5).tolist():
            name, new = OPERATIONS[code], next(following)
            operations.append((name, new, [at[each] for each in operands[: _operands(name)]]))
            at[out] = new
        return [at[each] for each in np.frombuffer(part.results, np.int32).tolist()]

    fixed = [*range(constants)]
    if traced.prelude is not None:
        fixed += unroll(traced.prelude, fixed + [0] * traced.prelude.registers)
    first = [*fixed, *range(constants, constants + read)]
    return operations, unroll(traced, first + [0] * traced.registers)


def _operands(name: str) -> int:
    """Return the number of operands of an operation."""
    return 1 + max(
        map(int, re.findall(r"\{(\d)\}", _EXPRESSIONS.get(name, "{1}" if name == "matrix_vector" else "{0}")))
    )


def _helpers(p: str, t: str, n: str, f: str, body: str) -> Iterator[str]:
    """Yield the helper functions that the body of a step calls."""
    across = f"{p}_row_minimum(" in body
    for name, sign in (("max", ">"), ("min", "<")):
        if f"{p}_{name}(" in body or (across and name == "min"):
            yield f"static inline {t} {p}_{name}({t} a, {t} b) {{ return a {sign} b || a != a ? a : b; }}\n"
    if across:
        yield f"""static inline void {p}_row_minimum(const {t} *a, {t} *out) {{
  {t} least = a[0];
  for (int j = 1; j < {n}; ++j) least = {p}_min(least, a[j]);
  for (int j = 0; j < {n}; ++j) out[j] = least;
}}
"""
    if f"{p}_matrix_vector(" in body:
        yield f"""/* Sums of products in NumPy's order: sequential below eight terms, else eight partial sums. */
static inline void {p}_matrix_vector(const {t} *a, const {t} *b, {t} *out) {{
  for (int i = 0; i < {n}; ++i, a += {n}) {{
    {t} sum = -0.0{f};
    int k = 0;
    if ({n} >= 8) {{
      {t} s[8];
      for (; k < 8; ++k) s[k] = a[k] * b[k];
      for (; k + 8 <= {n}; k += 8) {{
        for (int m = 0; m < 8; ++m) s[m] += a[k + m] * b[k + m];
      }}
      sum = ((s[0] + s[1]) + (s[2] + s[3])) + ((s[4] + s[5]) + (s[6] + s[7]));
    }}
    for (; k < {n}; ++k) sum += a[k] * b[k];
    out[i] = 0.0{f} + sum;
  }}
}}
"""
