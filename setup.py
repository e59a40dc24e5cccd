"""Build of the extensions, which are optional unless BATCHPID_REQUIRE_NATIVE=1; all else is in
pyproject.toml.

With BATCHPID_NATIVE=0 none is built.
"""

import os
import re
import sys
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext
from setuptools.errors import BaseError, CCompilerError

ROOT = Path(__file__).parent
REQUIRED = os.environ.get("BATCHPID_REQUIRE_NATIVE", "0")
"""Environment variable: "1" makes an extension that cannot be built an error, as for wheels that
are published.
"""
if REQUIRED not in ("0", "1"):
    sys.exit(
        f"batchpid: BATCHPID_REQUIRE_NATIVE is {REQUIRED!r}; set it to 1, or to 0 for a build"
        " without a compiler"
    )


def built(extension):
    """Return an extension, as setuptools has them, with the digests of its files."""
    return Extension(
        extension.module,
        [extension.files[0]],
        depends=["setup.py", "batchpid/native/extensions.py", *extension.files[1:]],
        include_dirs=["."],
        extra_compile_args=list(extension.flags),
        language="c++",
        define_macros=[
            ("Py_LIMITED_API", "0x030B0000"),
            ("BATCHPID_SOURCES", f'"{" ".join(extension.digests())}"'),
        ],
        py_limited_api=True,
        optional=REQUIRED == "0",  # without a compiler batchpid works as well, only slower
    )


class Build(build_ext):
    """Build of all extensions at once, which names one that fails, and the remedy, if extensions
    are required.
    """

    def finalize_options(self):
        """Use all cores by default."""
        super().finalize_options()
        self.parallel = self.parallel or True

    def build_extension(self, ext):
        """Compile and link one extension."""
        try:
            super().build_extension(ext)
        except (BaseError, CCompilerError, OSError) as error:
            if REQUIRED == "0":
                raise
            remedy = (
                "install a C++17 compiler, or unset BATCHPID_REQUIRE_NATIVE to build without native"
                " code"
            )
            sys.exit(f"batchpid: the extension {ext.name} cannot be built: {error}; {remedy}")


def structures(headers, constants):
    """Return structures.h: names of the fields of each structure that is marked FOR_PYTHON, and the
    numbers of enumerations; the compiler adds types and places. ``constants`` are those of Python.
    """
    text = re.sub(r"//.*", "", "".join(header.read_text() for header in headers))
    found = dict(re.findall(r"struct FOR_PYTHON (\w+) \{(.*?)\n\};", text, re.DOTALL))
    lines = [
        f"  FIELD({name}, {field})" for name, body in found.items() for field in fields(body, found)
    ]
    for name, body in re.findall(r"enum (?:class )?(\w+) : [\w:]+ \{(.*?)\};", text, re.DOTALL):
        lines += [f"  NUMBER({name}, {entry})" for entry in re.findall(r"[A-Z_]+", body)]
    checks = [f"static_assert(batchpid::{name} == {value});" for name, value in constants.items()]
    macro = "#define FOR_ALL \\\n" + " \\\n".join(lines)
    return "\n".join(["// Written by setup.py.", *checks, macro, ""])


def fields(body, found):
    """Return the names of the fields of a structure; those of a structure in it behind its own."""
    names = []
    for statement in body.partition("{")[0].split(";")[:-1]:
        first, _, rest = statement.strip().partition(" ")
        if "(*" in rest or "(*" in first:
            names += re.findall(r"\(\*(\w+)\)", statement)
        elif first in found and "*" not in rest:
            names += [f"{rest}.{name}" for name in fields(found[first], {})]
        else:
            names += [re.search(r"\w+(?=\[|$)", part.strip())[0] for part in rest.split(",")]
    return names


def write(path, text):
    """Write a header; an equal file keeps its time, or all would be compiled again."""
    file = ROOT / path
    if not file.is_file() or file.read_text() != text:
        file.write_text(text)


extensions = []
if os.environ.get("BATCHPID_NATIVE") != "0":
    sys.path.insert(0, str(ROOT))
    from batchpid.native import extensions as programs
    from batchpid.native.compiled import header, law_segments
    from batchpid.sim.engine import native
    from batchpid.stages import control_segments

    write("batchpid/native/codes.h", programs.codes())
    # One pass for each of the commonest laws, from their traces.
    write("batchpid/native/passes.h", header(law_segments(), ("float", "double")))
    write("batchpid/sim/engine/native/passes.h", header(control_segments(), ("double",)))
    folder = ROOT / "batchpid/sim/engine/native"
    written = "passes.h", "structures.h"
    sources = [path for path in sorted(folder.glob("*.h")) if path.name not in written]
    sources.append(ROOT / "batchpid/native/rigid_body.h")
    write(
        "batchpid/sim/engine/native/structures.h",
        structures(sources, {"WIDTH": native.WIDTH, "FARTHEST": native.FARTHEST}),
    )
    extensions = [*programs.EXTENSIONS.values(), *native.EXTENSIONS.values()]
setup(
    cmdclass={"build_ext": Build},
    # The longest to compile come first.
    ext_modules=[
        built(extension) for extension in sorted(extensions, key=lambda each: -len(each.files))
    ],
    options={"bdist_wheel": {"py_limited_api": "cp311"}},
)
