"""Build of the optional extensions; everything else about the package stands in pyproject.toml."""

import runpy
from pathlib import Path

from setuptools import Extension, setup

FOLDER = "sim/engine/native"
interface = runpy.run_path(str(Path(__file__).parent / FOLDER / "interface.py"))


def extension(name):
    """Return an extension with the digests of its tables and sources."""
    unit, headers, flags = interface["EXTENSIONS"][name]
    digests = {kind: interface[f"{kind}_digest"](name) for kind in ("tables", "sources")}
    macros = {f"BATCHPID_{kind.upper()}": f'"{digest}"' for kind, digest in digests.items()}
    return Extension(
        f"sim.engine.native.{name}",
        [f"{FOLDER}/{unit}"],
        depends=["setup.py", *(f"{FOLDER}/{file}" for file in ("interface.py", *headers))],
        extra_compile_args=list(flags),
        language="c++",
        define_macros=[("Py_LIMITED_API", "0x030B0000"), *macros.items()],
        py_limited_api=True,
        optional=True,  # without a compiler batchpid works as well, only slower
    )


setup(
    ext_modules=[extension(name) for name in interface["EXTENSIONS"]],
    options={"bdist_wheel": {"py_limited_api": "cp311"}},
)
