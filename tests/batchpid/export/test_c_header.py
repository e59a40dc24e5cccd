"""The exported C header: its guard, the robot's dynamics, and what compilers and sanitizers say;
test_law_conformance.py compares its law with NumPy, bit by bit.
"""

import dataclasses
import re
import shutil
import subprocess

import numpy as np
import pytest
from c_programs import COMPILERS, RESET, STRICT, TABLE, compiled
from hypothesis import given, settings
from hypothesis import strategies as st
from law_cases import (
    DT,
    JOINTS,
    OPTIONS,
    UNITS,
    Inputs,
    by_c,
    by_steps,
    generated_options,
    made_up_inputs,
)
from trees import planar, states, tree_of

import batchpid as bp
from batchpid.export import to_c
from batchpid.motors import guard as guards
from batchpid.task_space import bias, mass_matrix

pytestmark = pytest.mark.skipif(not COMPILERS, reason="no C compiler")
SANITIZED = ("-std=c99", "-O0", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")


def made(seed, units, dtype=np.float64, count=30):
    """Return params of one env and of any combination of options, and inputs."""
    joints = 1 + seed % 9
    params = bp.make_params(joints, **generated_options(seed, 1, joints, units), dtype=dtype)
    inputs = made_up_inputs(1, joints, count)
    return params, inputs.given("feedforward", *(["mass_matrix"] if units != "effort" else []))


@pytest.mark.slow
@pytest.mark.parametrize("compiler", COMPILERS)
@given(st.integers(0, 2**32), st.sampled_from(UNITS), st.sampled_from([np.float64, np.float32]))
@settings(max_examples=100)
def test_long_runs_are_bit_identical_under_sanitizers(compiler, seed, units, dtype):
    params, inputs = made(seed, units, dtype, 10_000)
    found = by_c(params, inputs, *SANITIZED, compiler=compiler)
    np.testing.assert_array_equal(found, by_steps(params, inputs))


def test_sanitizers_find_nothing():
    params, inputs = made(7, "effort")
    try:
        found = by_c(params, inputs, *SANITIZED)
    except subprocess.CalledProcessError as error:
        if "law.c" in str(error.cmd) and error.stderr is None:
            pytest.skip("this compiler has no sanitizer")
        raise
    np.testing.assert_array_equal(found, by_steps(params, inputs))


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_a_guard_stands_before_the_law(dtype):
    params = bp.make_params(JOINTS, 40.0, 5.0, 2.0, continuous=[True, False, False], dtype=dtype)
    limits = {"lower": -1.5, "upper": 1.5, "rate": 3.0, "acceleration": 20.0}
    guard = bp.make_guard(JOINTS, **limits, dtype=dtype)
    inputs = made_up_inputs(1).given("setpoint_rate")
    inputs = Inputs(*(None if each is None else each.astype(dtype) for each in inputs))
    state, setpoints, rates = guards.init(guard, inputs.measurement[0]), [], []
    for at, (setpoint, rate) in enumerate(zip(inputs.setpoint, inputs.setpoint_rate, strict=True)):
        if at == RESET:
            state = guards.init(guard, inputs.measurement[at])
        state, changed = guards.advance(guard, state, setpoint, DT)
        setpoints.append(state.setpoint)
        rates.append(np.where(changed, state.rate, rate))
    guarded = inputs._replace(setpoint=np.array(setpoints), setpoint_rate=np.array(rates))
    assert not np.array_equal(guarded.setpoint, inputs.setpoint)
    np.testing.assert_array_equal(by_c(params, inputs, guard=guard), by_steps(params, guarded))


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("g++"), reason="no C++ compiler")
def test_it_compiles_as_cpp_and_neither_allocates_nor_keeps_global_state(tmp_path):
    params = bp.make_params(2, 1.0, 1.0, 0.1)
    tree = planar((1.0, 1.0))
    (tmp_path / "law.h").write_text(to_c(params, DT, joint_names=tree.joint_names, tree=tree).text)
    guard = bp.make_guard(3, lower=-1.5, upper=1.5, rate=3.0, acceleration=20.0)
    whole = {
        "effort_limit": 3.0,
        "effort_rate_limit": 9.0,
        "anti_windup": "conditional",
        "gain_units": "mass_matrix",
    }
    every = to_c(bp.make_params(3, **OPTIONS["everything"]), DT, guard=guard, prefix="every")
    matrix = to_c(bp.make_params(3, 4.0, 2.0, 0.1, **whole), DT, prefix="matrix")
    (tmp_path / "every.h").write_text(every.text + matrix.text)
    (tmp_path / "law.cpp").write_text(
        '#include "law.h"\n#include "every.h"\n'
        "void each(double *x, every_state *a, matrix_state *b) {\n"
        "  every_init(a, x); every_reset(a, x); every_step(a, x, x, x, x);\n"
        "  matrix_init(b, x); matrix_reset(b, x); matrix_step(b, x, x, x, x, x); }\n"
        "void use(double *x) {\n"
        "  batchpid_mass_matrix(x, x + 2); batchpid_bias(x, x, x); }\n"
    )
    subprocess.run(["g++", *STRICT, "-O2", "-c", "law.cpp"], cwd=tmp_path, check=True)
    listed = subprocess.run(
        ["nm", "law.o"], cwd=tmp_path, capture_output=True, text=True, check=True
    ).stdout
    # Nothing undefined but mathematics (malloc would be), and no data that can change.
    assert not re.search(r" U (?!sincos|sin|cos|sqrt|__stack_chk_fail|_GLOBAL)| [BbDd] ", listed), (
        listed
    )


@pytest.mark.parametrize(
    ("name", "dtype"),
    [
        pytest.param("panda", np.float64, marks=pytest.mark.slow),
        (0, np.float64),
        ("planar", np.float32),
    ],
)
def test_the_dynamics_of_the_robot(name, dtype, tmp_path):
    tree = planar(gravity=(0.0, -9.81, 0.0)) if name == "planar" else tree_of(name)
    tree = dataclasses.replace(tree, armature=np.linspace(0, 0.2, tree.dof))
    params, n = bp.make_params(tree.dof, 1.0, dtype=dtype), tree.dof
    (tmp_path / "arm.h").write_text(
        to_c(params, DT, joint_names=tree.joint_names, prefix="arm", tree=tree).text
    )
    q, v = (each.astype(dtype) for each in states(tree, 20))
    flags = SANITIZED if name == "panda" else ("-std=c99", "-O2")
    binary = compiled(
        tmp_path, TABLE.format(n=n, t="double" if dtype == np.float64 else "float"), *flags
    )
    ran = subprocess.run(
        [binary], input=np.hstack([q, v]).tobytes(), capture_output=True, check=True
    )
    found = np.frombuffer(ran.stdout, dtype).reshape(20, -1)
    wide = [each.astype(np.float64) for each in (q, v)]
    parts = (
        mass_matrix(tree, wide[0]).reshape(20, -1),
        bias(tree, *wide),
        bias(tree, wide[0], 0 * wide[0]),
    )
    for at, expected in zip(np.split(found, [n * n, n * n + n], axis=1), parts, strict=True):
        size = max(np.abs(expected).max(), 1.0)
        np.testing.assert_allclose(
            at, expected, rtol=0, atol=(1e-12 if dtype == np.float64 else 1e-5) * size
        )
