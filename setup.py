"""Build of the optional extensions; everything else about the package stands in pyproject.toml."""

import importlib.util
import runpy
import sys
from pathlib import Path

from setuptools import Extension, setup

ROOT = Path(__file__).parent
DEFINITIONS = ("batchpid/native/operations.py", "sim/engine/native/interface.py")


def load(name):
    """Import one module of batchpid without its package, which needs NumPy."""
    spec = importlib.util.spec_from_file_location(name, ROOT / f"{name.replace('.', '/')}.py")
    sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sys.modules[name])


def built(extension, definition):
    """Return an extension, as setuptools has them, with the digests of its tables and sources."""
    digests = {"TABLES": extension.tables_digest(), "SOURCES": extension.sources_digest()}
    macros = {f"BATCHPID_{kind}": f'"{digest}"' for kind, digest in digests.items()}
    return Extension(
        extension.module,
        [extension.files[0]],
        depends=["setup.py", "batchpid/native/extensions.py", definition, *extension.files[1:]],
        extra_compile_args=list(extension.flags),
        language="c++",
        define_macros=[("Py_LIMITED_API", "0x030B0000"), *macros.items()],
        py_limited_api=True,
        optional=True,  # without a compiler batchpid works as well, only slower
    )


load("batchpid.native.extensions")
load("batchpid.native.operations")
setup(
    ext_modules=[
        built(extension, definition)
        for definition in DEFINITIONS
        for extension in runpy.run_path(str(ROOT / definition))["EXTENSIONS"].values()
    ],
    options={"bdist_wheel": {"py_limited_api": "cp311"}},
)
