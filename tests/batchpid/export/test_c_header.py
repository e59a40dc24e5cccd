"""The exported C header computes the same efforts as the law in NumPy, bit by bit."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from law_cases import OPTIONS

import batchpid as bp
from batchpid.errors import InvalidArgumentError
from batchpid.export import to_c
from batchpid.law.computed_torque import advance_with_mass_matrix, per_inertia
from batchpid.motors import guard as guards

COMPILERS = [name for name in ("gcc", "clang") if shutil.which(name)]
pytestmark = pytest.mark.skipif(not COMPILERS, reason="no C compiler")
STRICT = ("-Wall", "-Wextra", "-Wpedantic", "-Werror", "-ffp-contract=off")
SINGLE = {name: case for name, case in OPTIONS.items() if not name.endswith("per env")}
DT = 0.003


def program(header: str, inputs: list[tuple[str, int]], prefix: str, kind: str, joints: int) -> str:
    """Return a program that reads steps from stdin and writes their efforts to stdout."""
    arrays = "".join(f"  {kind} {name}[{size}];\n" for name, size in inputs)
    reads = "".join(f"    if (fread({n}, sizeof({kind}), {size}, stdin) != {size}) return 0;\n" for n, size in inputs)
    arguments = ", ".join(name for name, _ in inputs)
    return f"""#include <stdio.h>
#include <string.h>
{header}
int main(void) {{
  {prefix}_state state;
  {kind} effort[{joints}];
{arrays}  memset(&state, 0, sizeof state);
  for (int at = 0;; ++at) {{
{reads}    if (at == 0) {prefix}_init(&state, measurement);
    if (at == 60) {prefix}_reset(&state, measurement);
    {prefix}_step(&state, {arguments}, effort);
    fwrite(effort, sizeof({kind}), {joints}, stdout);
  }}
}}
"""


def compiled(folder: Path, text: str, *flags: str, compiler: str = COMPILERS[0] if COMPILERS else "") -> Path:
    source, binary = folder / "law.c", folder / "law"
    source.write_text(text)
    subprocess.run([compiler, *STRICT, *flags, str(source), "-o", str(binary), "-lm"], check=True)
    return binary


def efforts_in_c(folder, params, options, columns, *flags, compiler=None):
    header = to_c(params, DT, **options).text
    kind = "float" if params.dtype == np.float32 else "double"
    sizes = [(name, column[0].size) for name, column in columns.items()]
    text = program(header, sizes, options.get("prefix", "batchpid"), kind, params.num_joints)
    chosen = {} if compiler is None else {"compiler": compiler}
    binary = compiled(folder, text, *(flags or ("-std=c99", "-O2")), **chosen)
    rows = np.concatenate([column.reshape(len(column), -1) for column in columns.values()], axis=1)
    ran = subprocess.run([binary], input=rows.astype(params.dtype).tobytes(), capture_output=True, check=True)
    return np.frombuffer(ran.stdout, params.dtype).reshape(-1, params.num_joints)


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
        optional = now.get("measurement_rate"), rate, now.get("feedforward")
        if "mass_matrix" in now:
            state, effort = advance_with_mass_matrix(k, state, r, y, now["mass_matrix"], *optional)
        else:
            scaled = per_inertia(k, now["inertia"]) if "inertia" in now else k
            state, effort = bp.advance(scaled, state, r, y, *optional)
        efforts.append(effort[0])
    return np.array(efforts)


def motion(seed: int, joints: int, dtype, names, steps: int = 100) -> dict[str, np.ndarray]:
    """Return random columns (steps, joints), with jumps, and with NaN where the law has an answer to it."""
    rng = np.random.default_rng(seed)
    columns = {name: rng.normal(0, 2, (steps, joints)) for name in ("setpoint", "measurement", *names)}
    columns["measurement"] = np.cumsum(columns["measurement"], axis=0) * 0.05
    if "inertia" in names:
        columns["inertia"] = rng.uniform(0.01, 2, (steps, joints))
    if "mass_matrix" in names:
        root = rng.normal(0, 1, (steps, joints, joints))
        columns["mass_matrix"] = root @ root.transpose(0, 2, 1)
    return {name: column.astype(dtype) for name, column in columns.items()}


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("name", SINGLE)
def test_every_option_is_bit_identical(name, dtype, tmp_path):
    params = bp.make_params(3, **SINGLE[name], dtype=dtype)
    columns = motion(1, 3, dtype, ("feedforward",))
    if "non_finite" in SINGLE[name]:
        columns["measurement"][20:23, 1] = np.nan
        columns["feedforward"][70, 2] = np.inf
    expected = efforts_in_numpy(params, columns)
    assert np.abs(expected[np.isfinite(expected)]).max() > 0.1
    np.testing.assert_array_equal(efforts_in_c(tmp_path, params, {}, columns), expected)


def settings_of_a_law(draw) -> tuple[bp.PIDParams, dict, list[str]]:
    joints, dtype = draw(st.integers(1, 9)), draw(st.sampled_from([np.float64, np.float32]))
    numbers = st.floats(0, 50, width=32)
    row = st.lists(numbers, min_size=joints, max_size=joints)
    options = {"kp": draw(row)}
    for name in ("ki", "kd", "derivative_filter_time", "setpoint_weight", "setpoint_weight_derivative", "deadband"):
        if draw(st.booleans()):
            options[name] = np.array(draw(row)) * (0.001 if name in ("derivative_filter_time", "deadband") else 1)
    if draw(st.booleans()):
        options["effort_limit"] = np.array(draw(row)) + 0.1
        options["anti_windup"] = draw(st.sampled_from(["none", "clamp", "conditional"]))
    options["integration"] = draw(st.sampled_from(["output_first", "integrate_first"]))
    options["continuous"] = draw(st.lists(st.booleans(), min_size=joints, max_size=joints))
    units = draw(st.sampled_from(["effort", "effort", "inertia", "mass_matrix"]))
    if units == "mass_matrix" and draw(st.booleans()):
        options["discretization"] = "implicit"
        options.pop("derivative_filter_time", None)
    options["measurement_rate"] = draw(st.sampled_from(["difference", "measured"]))
    params = bp.make_params(joints, **options, gain_units=units, dtype=dtype)
    inputs = ["measurement_rate"] if options["measurement_rate"] == "measured" else []
    inputs += [each for each in ("setpoint_rate", "feedforward") if draw(st.booleans())]
    guard = None
    if draw(st.booleans()):
        guard = bp.make_guard(joints, lower=-1.5, upper=1.5, rate=3.0, acceleration=20.0, dtype=dtype)
    extra = [] if units == "effort" else [units]
    return params, {"guard": guard, "inputs": inputs, "prefix": "arm"}, [*inputs, *extra]


@pytest.mark.parametrize("compiler", COMPILERS)
@given(data=st.data())
@settings(max_examples=15)
def test_random_settings_are_bit_identical(tmp_path_factory, compiler, data):
    params, options, names = settings_of_a_law(data.draw)
    columns = motion(data.draw(st.integers(0, 99)), params.num_joints, params.dtype, names)
    expected = efforts_in_numpy(params, columns, options["guard"])
    folder = tmp_path_factory.mktemp("c")
    np.testing.assert_array_equal(efforts_in_c(folder, params, options, columns, compiler=compiler), expected)


def test_sanitizers_find_nothing(tmp_path):
    params = bp.make_params(
        8,
        **SINGLE["everything"]
        | {"kp": 1.0, "ki": 2.0, "kd": 0.1, "effort_limit": 3.0, "anti_windup": "conditional", "continuous": True},
    )
    columns = motion(2, 8, np.float64, ("feedforward",))
    flags = ("-std=c99", "-O1", "-g", "-fsanitize=undefined", "-fno-sanitize-recover=all")
    try:
        found = efforts_in_c(tmp_path, params, {}, columns, *flags)
    except subprocess.CalledProcessError as error:
        if "law.c" in str(error.cmd) and error.stderr is None:
            pytest.skip("this compiler has no sanitizer")
        raise
    np.testing.assert_array_equal(found, efforts_in_numpy(params, columns))


@pytest.mark.skipif(not shutil.which("g++"), reason="no C++ compiler")
def test_it_compiles_as_cpp_and_neither_allocates_nor_keeps_global_state(tmp_path):
    params = bp.make_params(2, **{**SINGLE["pid"], "kp": 1.0, "ki": 1.0, "kd": 0.1})
    (tmp_path / "law.cpp").write_text(
        to_c(params, DT).text + "void use(batchpid_state *s, double *x) {\n"
        "  batchpid_init(s, x); batchpid_step(s, x, x, x, x); }\n"
    )
    subprocess.run(["g++", *STRICT, "-O2", "-c", "law.cpp"], cwd=tmp_path, check=True)
    listed = subprocess.run(["nm", "law.o"], cwd=tmp_path, capture_output=True, text=True, check=True).stdout
    assert not re.search(r" [UBbDd] (?!_GLOBAL)", listed), listed  # nothing undefined, such as malloc, and no data


def test_what_cannot_be_exported_is_an_error():
    params = bp.make_params(2, kp=1.0)
    cases = {
        r"params: are for 2 envs": lambda: to_c(bp.make_params(2, kp=[[1.0, 2.0], [3.0, 4.0]]), DT),
        r"prefix.* is no name in C": lambda: to_c(params, DT, prefix="a-b"),
        r"inputs.* lack measurement_rate": lambda: to_c(params.replace(measurement_rate="measured"), DT, inputs=()),
        r"dt": lambda: to_c(params, 0.0),
        r"inputs": lambda: to_c(params, DT, inputs=("velocity",)),
    }
    for message, call in cases.items():
        with pytest.raises(InvalidArgumentError, match=message):
            call()
