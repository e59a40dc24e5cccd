"""Statements of a traced step in C: loops over the joints, and the operations across joints between
them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from batchpid.arrays.array_types import Array
from batchpid.native.operations import OPERATIONS
from batchpid.native.tracing import Trace

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
"""Elementwise operations in C. A mask is 1 or 0. A NaN propagates through max and min, as in
NumPy.
"""
_ACROSS = ("row_minimum", "matrix_vector")
"""Operations that combine the joints."""


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
        return "float" if self.dtype == np.float32 else "double"

    @property
    def suffix(self) -> str:
        """Suffix of literals and of the functions of ``math.h``."""
        return "f" if self.dtype == np.float32 else ""

    @property
    def size(self) -> str:
        """Name of the constant with the number of joints."""
        return f"{self.prefix.upper()}_JOINTS"

    def number(self, value: float) -> str:
        """Return a number of the dtype as a literal that reads back as the same number."""
        if math.isinf(value):
            return "-INFINITY" if value < 0 else "INFINITY"
        return f"{self.dtype.type(value).item()!r}{self.suffix}"

    def table(self, name: str, values: Array) -> str:
        """Return the statement of a constant table ``name``, an array ``values`` (joints, ...)."""
        rows = np.asarray(values)
        size = "".join(f"[{extent}]" for extent in (self.size, *rows.shape[1:]))
        return f"  static const {self.type} {name}{size} = {self._braces(rows)};\n"

    def _braces(self, values: Array) -> str:
        return (
            "{"
            + ", ".join(
                self._braces(row) if row.ndim else self.number(float(row)) for row in values
            )
            + "}"
        )


class Value(NamedTuple):
    """Value of the law for each joint: an expression for joint ``j``, and whether it is an array of
    temporaries.
    """

    text: str
    array: str | None = None
    """Name of the array, for operations across joints."""


def statements(
    c: Dialect, traced: Trace, constants: list[Value], read: list[Value], results: list[str]
) -> Iterator[str]:
    """Yield the statements of a step: loops over the joints, with the operations across joints
    between them.
    """
    operations, ends = _unrolled(traced, len(constants), len(read))
    values = dict(enumerate([*constants, *read]))
    starts = [0, *(at for at, each in enumerate(operations) if each[0] in _ACROSS), len(operations)]
    loop_of = {
        each[1]: sum(start <= at for start in starts[1:]) for at, each in enumerate(operations)
    }
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
        yield f"  {c.type} {', '.join(f't{at}[{c.size}]' for at in arrays)};\n"
    for loop, (start, stop) in enumerate(pairwise(starts)):
        first = operations[start] if start < stop else None
        if first is not None and first[0] in _ACROSS:
            yield _across(c, first[0], f"t{first[1]}", [values[each] for each in first[2]])
            values[first[1]] = Value(f"t{first[1]}[j]", f"t{first[1]}")
            start += 1
        if start == stop and loop < last:
            continue
        yield f"  for (int j = 0; j < {c.size}; ++j) {{\n"
        for name, out, operands in operations[start:stop]:
            texts = [values[each].text for each in operands]
            keys = {"p": c.prefix, "f": c.suffix, "one": c.number(1.0), "zero": c.number(0.0)}
            target = f"t{out}[j]" if out in shared else f"const {c.type} t{out}"
            yield f"    {target} = {_EXPRESSIONS[name].format(*texts, **keys)};\n"
            values[out] = Value(f"t{out}[j]", f"t{out}") if out in shared else Value(f"t{out}")
        if loop == last:
            yield from _stores(c, results, [values[end].text for end in ends])
        yield "  }\n"


def _stores(c: Dialect, places: list[str], texts: list[str]) -> Iterator[str]:
    """Yield the statements that write the results; the old state is read before it is
    overwritten.
    """
    for at, (place, text) in enumerate(zip(places, texts, strict=True)):
        if text.startswith("state->") and text != place:
            texts[at] = f"old{at}"
            yield f"    const {c.type} old{at} = {text};\n"
    yield from (
        f"    {place} = {text};\n"
        for place, text in zip(places, texts, strict=True)
        if place != text
    )


def _across(c: Dialect, name: str, out: str, operands: list[Value]) -> str:
    """Return the call of an operation across joints."""
    return (
        f"  {c.prefix}_{name}({', '.join(each.array or each.text for each in operands)}, {out});\n"
    )


def _unrolled(
    traced: Trace, constants: int, read: int
) -> tuple[list[tuple[str, int, list[int]]], list[int]]:
    """Return the operations ``(name, value, operands)`` of a trace, each with a new value, and the
    values returned.

    The operations on constants come first. Values below ``constants + read`` are constants and
    inputs of a step.
    """
    operations: list[tuple[str, int, list[int]]] = []
    following = iter(range(constants + read, 10**9))

    def unroll(part: Trace, at: list[int]) -> list[int]:
        for code, out, *operands in (
            np.frombuffer(part.operations, np.int32).reshape(-1, 5).tolist()
        ):
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
        map(
            int,
            re.findall(
                r"\{(\d)\}", _EXPRESSIONS.get(name, "{1}" if name == "matrix_vector" else "{0}")
            ),
        )
    )


def helpers(c: Dialect, body: str) -> Iterator[str]:
    """Yield the helper functions that the body of a step calls."""
    p = c.prefix
    t = c.type
    n = c.size
    f = c.suffix
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
