"""Build of the optional extensions; everything else about the package stands in pyproject.toml."""

import importlib.util
import sys
from pathlib import Path

from setuptools import Extension, setup

ROOT = Path(__file__).parent
MODULES = ("batchpid.native.extensions", "batchpid.native.operations", "batchpid.sim.engine.native.interface")
"""Definitions of the extensions, each after those that it imports."""


def load(name):
    """Return a module, imported without its package: batchpid needs NumPy."""
    spec = importlib.util.spec_from_file_location(name, ROOT / f"{name.replace('.', '/')}.py")
    sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sys.modules[name])
    return sys.modules[name]


def built(extension):
    """Return an extension, as setuptools has them, with the digests of its tables and sources."""
    digests = {"TABLES": extension.tables_digest(), "SOURCES": extension.sources_digest()}
    macros = {f"BATCHPID_{kind}": f'"{digest}"' for kind, digest in digests.items()}
    return Extension(
        extension.module,
        [extension.files[0]],
        depends=["setup.py", *(f"{name.replace('.', '/')}.py" for name in MODULES), *extension.files[1:]],
        include_dirs=["."],
        extra_compile_args=list(extension.flags),
        language="c++",
        define_macros=[("Py_LIMITED_API", "0x030B0000"), *macros.items()],
        py_limited_api=True,
        optional=True,  # without a compiler batchpid works as well, only slower
    )


modules = [load(name) for name in MODULES]
setup(
    ext_modules=[built(extension) for module in modules[1:] for extension in module.EXTENSIONS.values()],
    options={"bdist_wheel": {"py_limited_api": "cp311"}},
)
