"""Statements of a traced step in C: loops over the joints, and the operations across joints between
them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from batchpid.arrays.array_types import Array
from batchpid.native.extensions import OPERATIONS
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
    "exp": "exp{f}({0})",
    "tanh": "tanh{f}({0})",
    "sin": "sin{f}({0})",
    "sign": "{0} > {zero} ? {one} : {0} < {zero} ? -{one} : {0}",
    "isfinite": "{0} - {0} == {zero} ? {one} : {zero}",
    "where": "{0} != {zero} ? {1} : {2}",
    "multiply_add": "{0} * {1} + {2}",
    "add_subtract": "{0} + {1} - {2}",
    "subtract_multiply": "({0} - {1}) * {2}",
    "take_row": "{0}[(int){1}]",
    "clip": "{p}_min({p}_max({0}, {1}), {2})",
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
