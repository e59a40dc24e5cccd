"""Build of the optional extensions; everything else about the package stands in pyproject.toml."""

from setuptools import Extension, setup

setup(
    ext_modules=[
        Extension(
            "sim.engine.native._gateway",
            ["sim/engine/native/gateway.cpp"],
            depends=[
                f"sim/engine/native/{name}.h" for name in ("buffer", "gateway", "rigid_body", "sim_step", "xla_call")
            ],
            extra_compile_args=["-std=c++17", "-O2"],
            language="c++",
            define_macros=[("Py_LIMITED_API", "0x030B0000")],
            py_limited_api=True,
            optional=True,  # without a compiler batchpid works as well, only slower
        ),
        Extension(
            "sim.engine.native._batch_dynamics",
            ["sim/engine/native/batch_dynamics.cpp"],
            depends=["sim/engine/native/buffer.h", "sim/engine/native/rigid_body.h"],
            extra_compile_args=["-std=c++17", "-O3", "-ffp-contract=off", "-fno-math-errno", "-Wno-psabi"],
            language="c++",
            define_macros=[("Py_LIMITED_API", "0x030B0000")],
            py_limited_api=True,
            optional=True,
        ),
        Extension(
            "sim.loop._law_program",
            ["sim/loop/law_program.cpp"],
            extra_compile_args=["-std=c++17", "-O3", "-ffp-contract=off", "-fno-math-errno"],  # rounded as NumPy rounds
            language="c++",
            define_macros=[("Py_LIMITED_API", "0x030B0000")],
            py_limited_api=True,
            optional=True,
        ),
    ],
    options={"bdist_wheel": {"py_limited_api": "cp311"}},
)
