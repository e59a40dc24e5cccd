"""The exported C header computes the same efforts as the law in NumPy, bit by bit, and the robot's
dynamics.
"""

from __future__ import annotations

import dataclasses
import re
import shutil
import subprocess

import numpy as np
import pytest
from c_programs import COMPILERS, STRICT, TABLE, compiled, efforts_in_c
from hypothesis import given, settings
from hypothesis import strategies as st
from law_cases import OPTIONS
from trees import planar, states, tree_of

import batchpid as bp
from batchpid.export import to_c
from batchpid.law import advance_with_mass_matrix
from batchpid.motors import guard as guards
from batchpid.task_space import bias, gravity, mass_matrix

pytestmark = pytest.mark.skipif(not COMPILERS, reason="no C compiler")
SINGLE = {name: case for name, case in OPTIONS.items() if not name.endswith("per env")}
SANITIZED = ("-std=c99", "-O0", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
DT = 0.003


def in_c(folder, params, options, columns, *flags, compiler=None):
    """Return the efforts of the header with these options."""
    header, prefix = to_c(params, DT, **options).text, options.get("prefix", "batchpid")
    return efforts_in_c(folder, params, header, columns, *flags, prefix=prefix, compiler=compiler)


def efforts_in_numpy(params, columns, guard=None):
    """Return the efforts of the pure functions, step by step."""
    given = {name: column[:, None] for name, column in columns.items()}
    state, efforts, k = None, [], bp.discretise(params, DT)
    for at in range(len(given["setpoint"])):
        now = {name: column[at] for name, column in given.items()}
        y, r, rate = now["measurement"], now["setpoint"], now.get("setpoint_rate")
        if at == 0:
            state = bp.init(params, y)
            held = None if guard is None else guards.init(guard, y)
        if at == 60:
            state = bp.reset(params, state, y, np.array([True]), keep_integral=True)
            held = None if guard is None else guards.init(guard, y)
        if guard is not None:
            held, changed = guards.advance(guard, held, r, DT)
            r, rate = held.setpoint, None if rate is None else np.where(changed, held.rate, rate)
        optional = now.get("measurement_rate"), rate
        added = {"feedforward": now.get("feedforward")}
        if "mass_matrix" in now:
            matrix = now["mass_matrix"]
            state, terms = advance_with_mass_matrix(k, state, r, y, matrix, *optional, **added)
        else:
            state, terms = bp.advance(k, state, r, y, *optional, **added)
        efforts.append(terms.effort[0])
    return np.array(efforts)


def motion(seed: int, joints: int, dtype, names, steps: int = 100) -> dict[str, np.ndarray]:
    """Return random columns (steps, joints), with jumps, and with NaN where the law has an answer
    to it.
    """
    rng = np.random.default_rng(seed)
    columns = {
        name: rng.normal(0, 2, (steps, joints)) for name in ("setpoint", "measurement", *names)
    }
    columns["measurement"] = np.cumsum(columns["measurement"], axis=0) * 0.05
    if "mass_matrix" in names:
        root = rng.normal(0, 1, (steps, joints, joints))
        columns["mass_matrix"] = root @ root.transpose(0, 2, 1)
    return {name: column.astype(dtype) for name, column in columns.items()}


def settings_of_a_law(draw) -> tuple[bp.PIDParams, dict, list[str]]:
    joints, dtype = draw(st.integers(1, 9)), draw(st.sampled_from([np.float64, np.float32]))
    numbers = st.floats(0, 50, width=32)
    row = st.lists(numbers, min_size=joints, max_size=joints)
    options = {"kp": draw(row)}
    for name in (
        "ki",
        "kd",
        "derivative_filter_time",
        "setpoint_weight",
        "setpoint_weight_derivative",
        "deadband",
    ):
        if draw(st.booleans()):
            options[name] = np.array(draw(row)) * (
                0.001 if name in ("derivative_filter_time", "deadband") else 1
            )
    if draw(st.booleans()):
        options["effort_limit"] = np.array(draw(row)) + 0.1
        options["anti_windup"] = draw(
            st.sampled_from(["none", "clamp", "conditional", "back_calculation"])
        )
        if options["anti_windup"] == "back_calculation":
            options["tracking_time"] = 0.1
    for name, unit in (("effort_rate_limit", 100.0), ("integral_limit", 0.1)):
        if draw(st.booleans()):
            options[name] = (np.array(draw(row)) + 0.1) * unit
    options["non_finite"] = draw(st.sampled_from(["propagate", "zero", "hold"]))
    options["continuous"] = draw(st.lists(st.booleans(), min_size=joints, max_size=joints))
    units = draw(st.sampled_from(["effort", "effort", "mass_matrix"]))
    if units == "mass_matrix":  # its law lacks these
        for name in ("non_finite", "tracking_time"):
            options.pop(name, None)
        if options.get("anti_windup") == "back_calculation":
            options["anti_windup"] = "conditional"
    if units == "mass_matrix" and draw(st.booleans()):
        options["discretization"] = "implicit"
        options.pop("derivative_filter_time", None)
    options["measurement_rate"] = draw(st.sampled_from(["difference", "measured"]))
    params = bp.make_params(joints, **options, gain_units=units, dtype=dtype)
    inputs = ["measurement_rate"] if options["measurement_rate"] == "measured" else []
    inputs += [each for each in ("setpoint_rate", "feedforward") if draw(st.booleans())]
    guard = None
    if draw(st.booleans()):
        guard = bp.make_guard(
            joints, lower=-1.5, upper=1.5, rate=3.0, acceleration=20.0, dtype=dtype
        )
    extra = [] if units == "effort" else [units]
    return params, {"guard": guard, "inputs": inputs, "prefix": "arm"}, [*inputs, *extra]


def check_random_settings(folder, data, compiler, steps, *flags):
    """Compare a law of random settings in C and in NumPy on ``steps`` random steps."""
    params, options, names = settings_of_a_law(data.draw)
    columns = motion(data.draw(st.integers(0, 99)), params.num_joints, params.dtype, names, steps)
    if params.non_finite is not None:
        columns["measurement"][steps // 3, 0] = np.nan
        columns["setpoint"][steps // 2, -1] = np.inf
    expected = efforts_in_numpy(params, columns, options["guard"])
    np.testing.assert_array_equal(
        in_c(folder, params, options, columns, *flags, compiler=compiler), expected
    )


@pytest.mark.quick_rows(1)
@pytest.mark.parametrize("compiler", COMPILERS)
@given(data=st.data())
@settings(max_examples=8)
def test_random_settings_are_bit_identical(tmp_path_factory, compiler, data):
    check_random_settings(tmp_path_factory.mktemp("c"), data, compiler, 100)


@pytest.mark.slow
@given(data=st.data())
@settings(max_examples=200)
def test_long_runs_of_random_settings_are_bit_identical_under_sanitizers(tmp_path_factory, data):
    compiler = data.draw(st.sampled_from(COMPILERS))
    check_random_settings(tmp_path_factory.mktemp("c"), data, compiler, 10_000, *SANITIZED)


def test_sanitizers_find_nothing(tmp_path):
    params = bp.make_params(
        8,
        **SINGLE["everything"]
        | {
            "kp": 1.0,
            "ki": 2.0,
            "kd": 0.1,
            "effort_limit": 3.0,
            "anti_windup": "conditional",
            "continuous": True,
        },
    )
    columns = motion(2, 8, np.float64, ("feedforward",))
    try:
        found = in_c(tmp_path, params, {}, columns, *SANITIZED)
    except subprocess.CalledProcessError as error:
        if "law.c" in str(error.cmd) and error.stderr is None:
            pytest.skip("this compiler has no sanitizer")
        raise
    np.testing.assert_array_equal(found, efforts_in_numpy(params, columns))


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("g++"), reason="no C++ compiler")
def test_it_compiles_as_cpp_and_neither_allocates_nor_keeps_global_state(tmp_path):
    params = bp.make_params(2, **{**SINGLE["pid"], "kp": 1.0, "ki": 1.0, "kd": 0.1})
    tree = planar((1.0, 1.0))
    (tmp_path / "law.h").write_text(to_c(params, DT, joint_names=tree.joint_names, tree=tree).text)
    guard = bp.make_guard(3, lower=-1.5, upper=1.5, rate=3.0, acceleration=20.0)
    whole = {
        "effort_limit": 3.0,
        "effort_rate_limit": 9.0,
        "anti_windup": "conditional",
        "gain_units": "mass_matrix",
    }
    every = to_c(bp.make_params(3, **SINGLE["everything"]), DT, guard=guard, prefix="every")
    matrix = to_c(bp.make_params(3, 4.0, 2.0, 0.1, **whole), DT, prefix="matrix")
    (tmp_path / "every.h").write_text(every.text + matrix.text)
    (tmp_path / "law.cpp").write_text(
        '#include "law.h"\n#include "every.h"\n'
        "void each(double *x, every_state *a, matrix_state *b) {\n"
        "  every_init(a, x); every_reset(a, x); every_step(a, x, x, x, x);\n"
        "  matrix_init(b, x); matrix_reset(b, x); matrix_step(b, x, x, x, x, x); }\n"
        "void use(double *x) {\n"
        "  batchpid_controller arm(x); arm.step(x, x, x, x); arm.reset(x);\n"
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
    parts = mass_matrix(tree, wide[0]).reshape(20, -1), bias(tree, *wide), gravity(tree, wide[0])
    for at, expected in zip(np.split(found, [n * n, n * n + n], axis=1), parts, strict=True):
        size = max(np.abs(expected).max(), 1.0)
        np.testing.assert_allclose(
            at, expected, rtol=0, atol=(1e-12 if dtype == np.float64 else 1e-5) * size
        )
