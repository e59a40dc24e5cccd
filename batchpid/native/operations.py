"""Operations of programs, and the extension that executes them.

``setup.py`` imports this module without its package: it may import the standard library and the
module of extensions.
"""

from __future__ import annotations

from batchpid.native.extensions import ROUNDED, Extension

OPERATIONS = (
    *("add", "subtract", "multiply", "divide", "maximum", "minimum"),
    *("greater", "greater_equal", "less", "less_equal", "equal", "not_equal", "and", "or", "not"),
    *("negative", "absolute", "rint", "ceil", "floor", "sqrt", "sign", "isfinite"),
    *("where", "row_minimum", "matrix_vector", "multiply_add", "add_subtract"),
    *("subtract_multiply", "clip", "push", "take", "gather"),
)
"""Operations of programs, as Code in program.h."""
MASKS = frozenset(OPERATIONS[6:15]) | {"isfinite"}
"""Operations whose results are masks."""
OPERATION = ("code", "out", "first", "second", "third")
"""int32 numbers of an operation: its code, and registers; as Operation in program.h."""
MOST_SUMMED = 128
"""Largest number of terms for which a sum has NumPy's order."""


_FILES = ("make_program.h", "extension.h", "program.h", "operations.py")
PROGRAMS = tuple(f"batchpid/native/{name}" for name in _FILES)
"""Headers and tables of programs, for extensions that include them."""
PROGRAM = Extension(
    "batchpid.native._program", ("batchpid/native/program.cpp", *PROGRAMS), (*ROUNDED, "-pthread")
)
EXTENSIONS = {"_program": PROGRAM}
