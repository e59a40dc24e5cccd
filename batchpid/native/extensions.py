"""Native extensions: their files and tables, and loading of those that were built from the present
files.

``setup.py`` writes tables of this module into a header (:func:`codes`), so an extension works only
with the files that it was built from. ``setup.py`` compiles a digest of each file into the extension, and :func:`load`
compares them. ``setup.py`` imports this module without its package, before NumPy is installed: it
may import the standard library only. Modules that define extensions may import this one.
"""

from __future__ import annotations

import hashlib
import importlib
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
NOT_BUILT = "the extension was not built: it needs a C++ compiler when batchpid is installed"
ROUNDED = (
    "-std=c++17",
    "-O3",
    "-g0",
    "-fvisibility=hidden",
    "-ffp-contract=off",
    "-fno-math-errno",
    "-fno-trapping-math",
)
"""Compiler flags under which each operation is rounded as in NumPy: operations are not fused."""
LANES_ONLY = (
    "-fno-tree-loop-vectorize",
    "-fno-unswitch-loops",
    "-fno-split-loops",
    "-fno-ipa-cp-clone",
    "-fno-peel-loops",
    "-fno-tree-loop-distribute-patterns",
    "-fno-split-paths",
    "-fno-gcse",
    "-Wno-psabi",
)
"""Flags for code that computes on Lanes (lanes.h), which are vectors already: half to compile,
equally fast.
"""
VECTORIZED_ONLY = ("-O2", "-fvect-cost-model=dynamic")
"""Flags for code that gains nothing from -O3 but vectors: a third less to compile, equally fast."""


class Extension(NamedTuple):
    """Extension module in C++."""

    module: str
    """Full name, e.g. "batchpid.native._program"."""
    files: tuple[str, ...]
    """Paths in the repository: the C++ file to compile, the headers that it includes, and modules
    with its tables.
    """
    flags: tuple[str, ...]
    """Compiler flags."""

    def digests(self, root: Path = ROOT) -> list[str]:
        """Return "name=digest" for the flags, and for each file that exists: a wheel has no C++
        files.
        """
        files = {file: (root / file).read_bytes() for file in self.files if (root / file).is_file()}
        parts = {"flags": repr(self.flags).encode(), **files}
        return [
            f"{name}={hashlib.blake2b(part, digest_size=8).hexdigest()}"
            for name, part in parts.items()
        ]


OPERATIONS = (
    "add",
    "subtract",
    "multiply",
    "divide",
    "maximum",
    "minimum",
    "greater",
    "greater_equal",
    "less",
    "less_equal",
    "equal",
    "not_equal",
    "and",
    "or",
    "not",
    "negative",
    "absolute",
    "rint",
    "ceil",
    "floor",
    "sqrt",
    "exp",
    "tanh",
    "sin",
    "sign",
    "isfinite",
    "where",
    "row_minimum",
    "matrix_vector",
    "push",
    "gather",
    "take_row",
)
"""Operations of programs. program.h describes those that no array library has."""
ROW_WISE = ("row_minimum", "matrix_vector", "push", "gather", "take_row")
"""Operations whose result at a number depends on other numbers of its row, or on a table."""
MOST_OPERANDS = 48
"""Largest number of operands, and of results, of a fused segment."""
MASKS = frozenset(OPERATIONS[6:15]) | {"isfinite"}
"""Operations whose results are masks."""
MOST_SUMMED = 128
"""Largest number of terms for which a sum has NumPy's order."""


_FILES = ("make_program.h", "extension.h", "program.h", "codes.h", "extensions.py")
PROGRAMS = tuple(f"batchpid/native/{name}" for name in _FILES)
"""Headers and tables of programs, for extensions that include them."""
PROGRAM = Extension(
    "batchpid.native._program",
    ("batchpid/native/program.cpp", "batchpid/native/passes.h", *PROGRAMS),
    (*ROUNDED, "-pthread"),
)

KINEMATICS = ("qpos", "qvel", "tool", "pose", "jacobian", "jacobian_rate", "mass_matrix", "bias")
"""Arrays of ``kinematics`` in task_space.cpp, after the tree and the body of the tool; those after
the tool are results.
"""
LAW = (
    "pose",
    "jacobian",
    "jacobian_rate",
    "mass_matrix",
    "bias",
    "chain",
    "setpoint",
    "qpos",
    "qvel",
    "twist",
    "acceleration",
    "wrench",
    "feedforward",
    "damping",
    "added_inertia",
    "left",
    "posture",
    "integral",
    "kp",
    "kd",
    "c",
    "acceleration_share",
    "ki_dt",
    "ki_dt2",
    "posture_kp",
    "posture_kd",
    "limit_kp",
    "limit_kd",
    "limit_low",
    "limit_high",
    "integral_limit",
    "position_error_limit",
    "rotation_error_limit",
    "smallest_eigenvalue",
    "axes",
    "effort_limit",
    "turns",
    "coulomb",
    "band",
    "effort",
    "next_integral",
    "limited",
    "error",
    "force",
    "task",
    "posture_effort",
    "unsaturated",
    "task_share",
    "posture_share",
    "near_singular",
)
"""Arrays of ``law``: dynamics, inputs and state, coefficients, and results from the effort on."""

RIGID_BODIES = (
    "batchpid/native/lanes.h",
    "batchpid/native/rigid_body.h",
    "batchpid/native/extensions.py",
)
_TASK_SPACE_FILES = (
    "task_space.cpp",
    "extension.h",
    "mobility.h",
    "osc_law.h",
    "pose_search.h",
    "tables.h",
    "tool.h",
    "codes.h",
)

TASK_SPACE = Extension(
    "batchpid.native._task_space",
    (*(f"batchpid/native/{name}" for name in _TASK_SPACE_FILES), *RIGID_BODIES),
    (*ROUNDED, *LANES_ONLY),
)


def codes() -> str:
    """Return codes.h: the numbers of operations and arrays for C++."""
    enumerations = {
        "Code : std::int32_t": OPERATIONS,
        "Kinematics": (*(f"kinematics_{name}" for name in KINEMATICS), "kinematics"),
        "Law": (*(f"law_{name}" for name in LAW), "law"),
    }
    lines = ["// Written by setup.py: extensions.py.", "#pragma once", "#include <cstddef>"]
    lines += ["#include <cstdint>", "namespace batchpid {"]
    for kind, names in enumerations.items():
        entries = ", ".join(names).upper()
        lines.append(f"enum {kind} {{{entries}}};")
    lines += [f"constexpr std::size_t MOST_OPERANDS = {MOST_OPERANDS};", "}", ""]
    return "\n".join(lines)


EXTENSIONS = {"_program": PROGRAM, "_task_space": TASK_SPACE}


@cache
def load(extension: Extension) -> ModuleType:
    """Return the module of an extension.

    Raises
    ------
    ImportError
        It was built from other files, or cannot be loaded; the message ends with the remedy.
    ModuleNotFoundError
        It was not built.
    """
    name = extension.module.rpartition(".")[2]
    try:
        module = importlib.import_module(extension.module)
    except ModuleNotFoundError:
        raise ModuleNotFoundError(NOT_BUILT, name=extension.module) from None
    except ImportError as error:
        raise ImportError(f"{name} cannot be loaded ({error}); {_remedy(extension)}") from error
    # The digests were compiled in: a file that has changed since makes the extension stale.
    built = getattr(module, "sources", "").split()
    if changed := [
        digest.partition("=")[0] for digest in extension.digests() if digest not in built
    ]:
        raise ImportError(
            f"{name} was built from other sources ({', '.join(changed)}); {_remedy(extension)}"
        )
    return module


def _remedy(extension: Extension) -> str:
    """Return the remedy for a stale extension."""
    if all((ROOT / file).is_file() for file in ("setup.py", extension.files[0])):
        return f"run 'python setup.py build_ext --inplace --force' in {ROOT}"
    return "install batchpid again"
