"""Public entry points with invalid arguments raise an error of the project that names the
argument.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
import threading
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st
from identical import assert_identical
from robots import load_bundled

import batchpid as bp
from batchpid.errors import BatchPIDError
from batchpid.sim import Randomization, Recorder, Robot, Runner, Snapshot, Uniform, read_recording

CASES = int(os.environ.get("BATCHPID_SOAK_CASES", "5000"))
ROBOT = load_bundled("panda")
DOF, N = ROBOT.dof, 2
PARAMS = ROBOT.params()
ARRAY = np.zeros((N, DOF))


class Odd:
    """Object that no entry point expects, and that cannot be converted to an array."""

    def __array__(self, *_: Any, **__: Any) -> Any:
        raise RuntimeError("cannot be an array")

    def __repr__(self) -> str:
        return "Odd()"


NUMBERS = [0, 1, -1, 2, 10**9, -(10**9), 10**400, 0.0, -0.0, 0.5, -1.5, 1e-308, 1e300, -1e300]
NUMBERS += [
    *map(float, ("nan", "inf", "-inf")),
    np.float32(3),
    np.int8(-4),
    np.float64("nan"),
    np.bool_(True),
]
OTHERS = [
    None,
    True,
    False,
    "",
    "panda",
    "pid",
    "x" * 1000,
    b"bytes",
    "1.5",
    "nan",
    (),
    [],
    {},
    set(),
    object(),
    Odd(),
]
OTHERS += [
    len,
    int,
    1j,
    range(3),
    [None],
    ["a"] * DOF,
    [[1.0], [1.0, 2.0]],
    {"kp": 1},
    PARAMS,
    slice(1),
    ...,
]
OTHERS += [NotImplemented]
SHAPES = [
    (),
    (0,),
    (1,),
    (DOF,),
    (DOF + 1,),
    (N, DOF),
    (DOF, N),
    (N, 1),
    (1, DOF),
    (0, DOF),
    (N, 0),
    (N + 1, DOF),
]
SHAPES += [(3, N, DOF), (3, DOF), (1, 1, 1), (2, 2, 2, 2), (0, N, DOF), (N,)]
DTYPES = ["f8", "f4", "f2", "i8", "i1", "u1", "?", "c16", "O", "U3", "M8[s]"]


@st.composite
def arrays(draw: Any) -> Any:
    shape, dtype = draw(st.sampled_from(SHAPES)), draw(st.sampled_from(DTYPES))
    values = np.zeros(shape, dtype)
    if dtype in ("f8", "f4", "f2") and values.size and draw(st.booleans()):
        with np.errstate(all="ignore"):
            values.flat[draw(st.integers(0, values.size - 1))] = draw(
                st.sampled_from([np.nan, np.inf, -np.inf, 1.0, -1.0, 1e30, -1e30])
            )
    form = draw(st.sampled_from(["array", "list", "fortran", "strided", "readonly"]))
    if form == "list":
        return values.tolist()
    if form == "fortran":
        return np.asfortranarray(values)
    if form == "strided" and values.ndim:
        return np.repeat(values, 2, axis=-1)[..., ::2]
    values.flags.writeable = form != "readonly"
    return values


anything = st.one_of(st.sampled_from(NUMBERS), st.sampled_from(OTHERS), arrays())
# Values that are valid, but take long or need a large machine; -1 takes their place.
heavy = {
    "num_envs": lambda value: isinstance(value, int | np.integer) and value > 64,
    "workers": lambda value: isinstance(value, int | np.integer | None) and value != 0,
    "substeps": lambda value: isinstance(value, int | np.integer) and 1000 < value <= 1_000_000,
    "joints": lambda value: isinstance(value, int | np.integer) and value > 10_000,
}


def quiet(call: Callable[[], Any]) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return call()


@pytest.fixture(scope="module")
def runner():
    with Runner(ROBOT, N, params=PARAMS, workers=0, substeps=2) as made:
        yield made


@pytest.fixture(scope="module")
def containing():
    with Runner(ROBOT, N, params=PARAMS, workers=0, substeps=2, on_invalid_input="contain") as made:
        yield made


def make_runner(**options: Any) -> None:
    with Runner(**options) as made:
        made.step(ROBOT.start, substeps=1)


def assign(made: Runner, params: Any) -> None:
    made.params = params


def controller(method: str, **arguments: Any) -> Any:
    pid = bp.BatchPID(PARAMS, N, 1 / 2000)
    pid(ARRAY, ARRAY)
    result = getattr(pid, method)(**arguments)
    pid(ARRAY, ARRAY)
    return result


def make_controller(**arguments: Any) -> None:
    bp.BatchPID(**arguments)


def load_params(path: Any, joint_names: Any) -> None:
    """Load a valid file if ``path`` is None, else ``path``."""
    with tempfile.TemporaryDirectory() as folder:
        valid = Path(folder) / "params.yaml"
        bp.save_params(valid, PARAMS, ROBOT.joint_names)
        with contextlib.suppress(FileNotFoundError, IsADirectoryError):  # as documented
            bp.load_params(valid if path is None else path, joint_names)


GOOD_PARAMS = {
    "joints": DOF,
    "kp": 1.0,
    "ki": 0.1,
    "kd": 0.1,
    "effort_limit": 5.0,
    "effort_rate_limit": 100.0,
    "integral_limit": 3.0,
    "derivative_filter_time": 0.01,
    "setpoint_weight": 0.5,
    "deadband": 0.0,
    "anti_windup": "back_calculation",
    "tracking_time": 0.1,
    "continuous": np.zeros(DOF, bool),
    "measurement_rate": "measured",
    "gain_units": "effort",
    "discretization": "explicit",
    "non_finite": "propagate",
    "joint_names": ROBOT.joint_names,
    "dtype": np.float64,
}
GOOD_RUNNER = {
    "robot": ROBOT,
    "num_envs": N,
    "params": PARAMS,
    "workers": 0,
    "timestep": 1 / 2000,
    "substeps": 2,
    "control": "pid",
    "compensate": "gravity",
    "physics": "fast",
    "ground": True,
    "build": None,
    "on_fault": "hold",
    "speed_limit": 100.0,
    "randomization": Randomization(payload=Uniform(0, 1)),
    "on_invalid_input": "raise",
    "timeout": 10.0,
}
STEP = {"setpoint": ARRAY, "setpoint_rate": ARRAY, "feedforward": ARRAY}
ROLLOUT = {"setpoints": ARRAY[None], "setpoint_rates": ARRAY[None], "feedforwards": ARRAY[None]}
POSE = {"qpos": ROBOT.start, "qvel": ARRAY, "mask": np.ones(N, bool)}
MEASURED = {
    "measurement": ARRAY,
    "setpoint": ARRAY,
    "measurement_rate": ARRAY,
    "setpoint_rate": ARRAY,
    "feedforward": ARRAY,
}
MATRIX = np.eye(DOF)
BOUND = {
    "mass_matrix": MATRIX,
    "kp": 1.0,
    "kd": 1.0,
    "dt": 1e-3,
    "filter_time": 0.0,
    "damping": 0.0,
}

# name: (function, valid arguments)
ENTRIES: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {
    "make_params": (bp.make_params, GOOD_PARAMS),
    "BatchPID": (
        make_controller,
        {"params": PARAMS, "num_envs": N, "dt": 1e-3, "backend": "numpy"},
    ),
    "BatchPID.__call__": (lambda **kwargs: controller("__call__", **kwargs), MEASURED),
    "BatchPID.reset": (
        lambda **kwargs: controller("reset", **kwargs),
        {"measurement": ARRAY, "mask": np.ones(N, bool)},
    ),
    "BatchPID.track": (
        lambda **kwargs: controller("track", **kwargs),
        MEASURED | {"effort": ARRAY},
    ),
    "stability_bound": (bp.stability_bound, BOUND),
    "spectral_radius": (bp.spectral_radius, BOUND | {"ki": 1.0}),
    "load_params": (load_params, {"path": None, "joint_names": ROBOT.joint_names}),
    "Robot.load": (
        Robot.load,
        {
            "name_or_path": "panda",
            "package_dirs": (),
            "missing_meshes": "skip",
            "dissipation": "urdf",
            "fixed_base": True,
        },
    ),
    "Robot.params": (ROBOT.params, {"kp": 1.0, "ki": 0.0, "kd": 0.1, "effort_limit": 10.0}),
    "Robot.designed": (ROBOT.designed, {"gain_units": "effort"}),
    "Robot.check": (
        ROBOT.check,
        {
            "params": PARAMS,
            "qpos": ROBOT.start,
            "setpoint": ROBOT.start,
            "timestep": 1e-3,
            "control": "pid",
        },
    ),
    "Runner": (make_runner, GOOD_RUNNER),
    "Snapshot.load": (Snapshot.load, {"path": "none.npz"}),
    "read_recording": (read_recording, {"path": "none.h5", "every": 1}),
}
METHODS = {
    "step": STEP | {"substeps": 1},
    "rollout": ROLLOUT,
    "reset": POSE,
    "restore": {"snapshot": None},
    "params": {"params": PARAMS},
}


def attempt(data: Any, call: Callable[..., Any], good: dict[str, Any]) -> bool:
    """Call with some arguments replaced by anything; return whether the call succeeded.

    If it did not, it has raised an error of the project that names one of the replaced arguments.
    """
    names = data.draw(
        st.lists(st.sampled_from(sorted(good)), min_size=1, max_size=2, unique=True),
        label="replaced",
    )
    bad = {}
    for name in names:
        value = data.draw(anything, label=name)
        if name in heavy and heavy[name](value):
            value = -1
        bad[name] = value
    try:
        quiet(lambda: call(**(good | bad)))
        return True
    except BatchPIDError as error:
        refusal = error
    event("refused")
    assert len(str(refusal)) > 20
    assert names_it(refusal, bad), (refusal, bad)
    return False


def names_it(error: BatchPIDError, bad: dict[str, Any]) -> bool:
    """Return whether the error names one of the replaced arguments, or a file given as one."""
    words = [*bad, *(str(value) for value in bad.values() if isinstance(value, str) and value)]
    if {"path", "name_or_path", "every"} & set(bad):
        return True
    return any(word.removesuffix("s") in str(error) for word in words) or bool(
        {"joints", "num_envs", "joint_names"} & set(bad)
    )


def check_entry(data: Any) -> None:
    name = data.draw(st.sampled_from(sorted(ENTRIES)), label="entry")
    event(name)
    call, good = ENTRIES[name]
    attempt(data, call, good)


def check_method(data: Any, runner: Runner) -> None:
    method = data.draw(st.sampled_from(sorted(METHODS)), label="method")
    event(method)
    before = runner.observe(), runner.time
    calls = {name: getattr(runner, name) for name in METHODS} | {"params": partial(assign, runner)}
    succeeded = attempt(data, calls[method], METHODS[method])
    after = runner.observe()
    if not succeeded:
        assert runner.time == before[1]
        assert_identical(after, before[0])
    for table in (after.qpos, after.qvel, after.effort):
        assert np.isfinite(table[after.ok]).all()
    quiet(lambda: runner.reset())
    runner.params = PARAMS
    assert quiet(lambda: runner.step(ROBOT.start)).ok.all()


def fuzz(count: int, check: Callable[..., None], *arguments: Any) -> None:
    @settings(
        max_examples=count,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(data=st.data())
    def run(data: Any) -> None:
        check(data, *arguments)

    threads = threading.active_count()
    run()
    assert threading.active_count() <= threads


def test_entry_points_accept_or_name_any_argument():
    fuzz(100, check_entry)


def test_a_call_that_a_runner_refuses_changes_nothing(runner):
    fuzz(60, check_method, runner)


@pytest.mark.slow
def test_a_call_that_a_containing_runner_refuses_changes_nothing(containing):
    fuzz(60, check_method, containing)


@pytest.mark.slow
def test_very_many_calls(runner, containing):
    fuzz(CASES // 2, check_entry)
    fuzz(CASES // 4, check_method, runner)
    fuzz(CASES // 4, check_method, containing)


@pytest.mark.parametrize("name", sorted(ENTRIES))
def test_the_valid_arguments_of_these_tests_are_accepted(name):
    call, good = ENTRIES[name]
    if name in ("Snapshot.load", "read_recording"):
        with pytest.raises(BatchPIDError):
            call(**good)
    else:
        quiet(lambda: call(**good))


@pytest.mark.parametrize("arguments", [("run.txt",), (3,), ("run.h5", None)])
def test_a_recorder_that_is_refused_is_not_attached(arguments, runner):
    path, recorded = (*arguments, runner)[:2]
    with pytest.raises(BatchPIDError):
        Recorder(path, recorded)
    assert runner.recorder is None
