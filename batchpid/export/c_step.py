"""Statements of a traced step in C: loops over the joints, and the operations across joints between
them. Beside the law: C functions of a robot's rigid-body dynamics, and of a plan.

The text of these functions is in ``c_rigid_body.h`` and ``c_plan.h``. The curve of a plan and its
limits are traced from :mod:`batchpid.plan.sampling`; the rows of a chunk are blended by the same
operations in the same order. So samples are bit-identical. The last bits of the dynamics differ
from NumPy's.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from batchpid.arrays.array_types import Array, Pytree
from batchpid.arrays.trees import leaves, structure
from batchpid.motors.guard import GuardState
from batchpid.native.extensions import OPERATIONS
from batchpid.native.tracing import Trace, trace_trees
from batchpid.plan import sampling as model
from batchpid.plan.plans import SPARE_ROWS, Plan
from batchpid.plan.sampling import PlanState
from batchpid.task_space.rigid_tree import RigidTree

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
    "exp": "exp{f}({0})",
    "tanh": "tanh{f}({0})",
    "sin": "sin{f}({0})",
    "sign": "{0} > {zero} ? {one} : {0} < {zero} ? -{one} : {0}",
    "isfinite": "{0} - {0} == {zero} ? {one} : {zero}",
    "where": "{0} != {zero} ? {1} : {2}",
    "take_row": "{0}[(int){1}]",
}
"""Elementwise operations in C. A mask is 1 or 0. A NaN propagates through max and min, as in
NumPy.
"""
_ACROSS = {"row_minimum": "{0}", "matrix_vector": "{0}{1}"}
"""Operations that combine the joints, and their operands."""


def comment(name: str) -> str:
    """Return a name as text of a comment in C, from which no compiler reads anything else.

    A backslash, a question mark (of a trigraph), an asterisk and characters that are not printable
    stand as their numbers, as in U+005C.
    """
    return "".join(
        character
        if character.isprintable() and character not in "\\?*"
        else f"U+{ord(character):04X}"
        for character in name
    )


class Dialect(NamedTuple):
    """Names and numbers of a header: the beginning of its names, the type of its numbers, the
    number of joints.
    """

    prefix: str
    dtype: np.dtype[Any]
    joints: int

    @property
    def type(self) -> str:
        """C type of a number."""
        if self.dtype == np.float32:
            return "float"
        return "double"

    @property
    def suffix(self) -> str:
        """Suffix of literals and of the functions of ``math.h``."""
        if self.dtype == np.float32:
            return "f"
        return ""

    @property
    def size(self) -> str:
        """Name of the constant with the number of joints."""
        return f"{self.prefix.upper()}_JOINTS"

    @property
    def loop(self) -> str:
        """Beginning of a loop over the joints."""
        return f"  for (int j = 0; j < {self.size}; ++j) {{\n"

    def translated(self, file: str, **parts: str) -> str:
        """Return the text of a file in this folder, which has the prefix "batchpid" and double
        numbers, in this dialect; ``parts`` replace the comments ``/* [name] */``.
        """
        text = (Path(__file__).parent / file).read_text()
        words = {"batchpid": self.prefix, "BATCHPID": self.prefix.upper(), "double": self.type}
        _, text = text.split("*/\n\n", 1)  # without the comment on the file
        text = re.sub(r"batchpid|BATCHPID|\bdouble\b", lambda match: words[match[0]], text)
        text = re.sub(r"\b(\d+\.\d+|(?:sin|cos|ceil)(?=\())", rf"\1{self.suffix}", text)
        for name, part in parts.items():
            before, after = re.split(rf" */\* \[{name}\] \*/\n", text)
            text = before + part + after
        return f"{text}\n"

    def number(self, value: float) -> str:
        """Return a number of the dtype as a literal that reads back as the same number."""
        if math.isinf(value):
            if value < 0:
                return "-INFINITY"
            return "INFINITY"
        return f"{self.dtype.type(value).item()!r}{self.suffix}"

    def table(self, name: str, values: Array) -> str:
        """Return the statement of a constant table ``name``, an array ``values`` (joints, ...)."""
        rows = np.asarray(values)
        size = "".join(f"[{extent}]" for extent in (self.size, *rows.shape[1:]))
        return f"  static const {self.type} {name}{size} = {self._braces(rows)};\n"

    def _braces(self, values: Array) -> str:
        if not values.ndim:
            return self.number(float(values))
        return f"{{{', '.join(map(self._braces, values))}}}"


def statements(
    c: Dialect,
    traced: Trace,
    names: list[str],
    constants: int,
    places: list[str],
) -> str:
    """Return the statements of a step: loops over the joints, with the operations across joints
    between them.

    ``names`` are expressions of the trace's constants, of which there are ``constants``, and of its
    inputs, for joint ``j``. The results are written to ``places``.
    """
    operations, ends = _unrolled(traced, constants, len(names) - constants)
    symbols = {
        "p": c.prefix,
        "f": c.suffix,
        "one": c.number(1.0),
        "zero": c.number(0.0),
    }
    arrays = ", ".join(f"t{out}[{c.size}]" for _, out, _ in operations)
    lines = [f"  {c.type} {arrays};\n"] if arrays else []

    def text(value: int) -> str:
        if value < len(names):
            return names[value]
        return f"t{value}[j]"

    # Loops are as long as they can be: a joint's values then stay in registers.
    in_loop = False
    for name, out, operands in operations:
        texts = [text(operand) for operand in operands]
        is_across = name in _ACROSS
        if in_loop == is_across:  # a loop ends before an operation across joints
            in_loop = not is_across
            lines.append(c.loop if in_loop else "  }\n")
        if is_across:
            whole = ", ".join(part.removesuffix("[j]") for part in (*texts, text(out)))
            lines.append(f"  {c.prefix}_{name}({whole});\n")
        else:
            lines.append(f"    {text(out)} = {_EXPRESSIONS[name].format(*texts, **symbols)};\n")
    if not in_loop:
        lines.append(c.loop)
    results = [text(end) for end in ends]
    for at, (place, result) in enumerate(zip(places, results, strict=True)):
        if result.startswith("state->") and result != place:
            # The old state is read before it is overwritten.
            lines.append(f"    const {c.type} old{at} = {result};\n")
            results[at] = f"old{at}"
    lines += [
        f"    {place} = {result};\n"
        for place, result in zip(places, results, strict=True)
        if place != result
    ]
    return "".join([*lines, "  }\n"])


def _unrolled(
    traced: Trace, constants: int, inputs: int
) -> tuple[list[tuple[str, int, list[int]]], list[int]]:
    """Return the operations ``(name, value, operands)`` of a trace, each with a new value, and the
    values returned.

    The operations on constants come first. Values below ``constants + inputs`` are constants and
    inputs of a step.
    """
    operations: list[tuple[str, int, list[int]]] = []

    def unroll(part: Trace, first: list[int]) -> list[int]:
        # Registers are reused; in C each value has a variable.
        values = first + [0] * part.registers  # the value in each register
        rows = np.frombuffer(part.operations, np.int32).reshape(-1, 5).tolist()
        for code, out, *operands in rows:
            name = OPERATIONS[code]
            value = constants + inputs + len(operations)
            read = [values[operand] for operand in operands[: _operands(name)]]
            operations.append((name, value, read))
            values[out] = value
        return [values[end] for end in np.frombuffer(part.results, np.int32).tolist()]

    # Operations on constants alone are part of the step in C, for the compiler to fold.
    fixed = list(range(constants))
    if traced.prelude is not None:
        fixed += unroll(traced.prelude, fixed)
    return operations, unroll(traced, fixed + list(range(constants, constants + inputs)))


def _operands(name: str) -> int:
    """Return the number of operands of an operation."""
    expression = _ACROSS.get(name) or _EXPRESSIONS[name]
    return len(set(re.findall(r"\{\d\}", expression)))


def helpers(c: Dialect, body: str) -> Iterator[str]:
    """Yield the helper functions that the body of a step calls."""
    p = c.prefix
    t = c.type
    n = c.size
    # Functions without a call are left out, since a compiler would warn of them.
    across = f"{p}_row_minimum(" in body
    for name, sign in (("max", ">"), ("min", "<")):
        if f"{p}_{name}(" in body or (across and name == "min"):
            yield (
                f"static inline {t} {p}_{name}({t} a, {t} b) {{ return a {sign} b || a != a ? a :"
                " b; }\n"
            )
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
    {t} sum = -0.0{c.suffix};
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
    out[i] = 0.0{c.suffix} + sum;
  }}
}}
"""


def rigid_body(c: Dialect, tree: RigidTree) -> str:
    """Return the functions ``PREFIX_mass_matrix``, ``PREFIX_bias`` and ``PREFIX_gravity`` of a
    tree.
    """
    bodies = tree.bodies
    above = _integers(c, "above", tree.body_parents)
    poses = above + c.table("k_turn", bodies.at_zero[:, :, :3].reshape(-1, 9))
    poses += c.table("k_place", bodies.at_zero[..., 3]) + c.table("k_center", bodies.center[:-1])
    poses += c.table("k_tensor", bodies.tensor[:-1].reshape(-1, 9))
    poses += _integers(c, "slides", bodies.slides[:, 0])
    coupling = _integers(c, "leader", tree.coupling.leader)
    coupling += c.table("multiplier", tree.coupling.multiplier)
    fall = ", ".join(map(c.number, bodies.gravity.tolist()))
    masses = above + coupling + c.table("k_mass", bodies.mass[:-1, 0])
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
    names = [f"state->{name}[j]" for name in ("knots", "rates", "weights")]
    names += ["begin0", "last0", *segment, "end0", "now0", "starved0", *held]

    def sampled(k: Plan, state: PlanState, t: Array, dt: Array) -> Pytree:
        state, setpoint, rate, _ = model.advance(k, state, t, dt)
        return state.guard, setpoint, rate

    def present(k: Plan, state: PlanState) -> Pytree:
        return model.evaluate(state.segment, state.now - state.end)[:2]

    def joined(k: Plan, _: PlanState, *knots: Array) -> Pytree:
        return model.cubic(k, *knots)

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

    row = [f"chunk[k * {n} + j]", "begin", "offset[j]", "slope[j]", "first", "step"]
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
        blended=body(model.blend, row, "blended[k][j]", "weights[k][j]"),
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
