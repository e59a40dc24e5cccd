"""Writing into an array after a call has no effect: every argument is copied at the boundary."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from robots import load_bundled

import batchpid as bp
from batchpid.sim import Runner, RunnerOptions

ROBOT = load_bundled("panda")
N, DOF = 4, ROBOT.dof


def scribble(value):
    """Overwrite every array of ``value``, and of the named tuples, objects and mappings in it."""
    if isinstance(value, np.ndarray):
        if value.flags.writeable:
            value[...] = True if value.dtype == bool else 77
    elif isinstance(value, Mapping):
        for part in value.values():
            scribble(part)
    elif isinstance(value, tuple | list):
        for part in value:
            scribble(part)
    elif hasattr(value, "__dict__"):
        scribble(vars(value))


def own(leaves):
    """Return named leaves in arrays that can be written to."""
    return type(leaves)(
        *(np.array(leaf) if isinstance(leaf, np.ndarray) else leaf for leaf in leaves)
    )


def limits(robot=ROBOT):
    return own(bp.make_guard(DOF, rate=np.full(DOF, 1.5)))


def motors(lag=0.002):
    return own(bp.make_actuators(DOF, lag=np.full(DOF, lag), coulomb=np.full(DOF, 0.1)))


def gains(kp):
    return own(ROBOT.params(kp=kp))._replace(kd=np.full((1, DOF), 4.0))


def test_a_runner_keeps_params_and_options_read_only():
    with Runner(
        ROBOT, 1, workers=0, params=gains(30.0), guard=limits(), actuators=motors()
    ) as runner:
        for leaves in (runner.params, runner.options.guard, runner.actuators):
            assert not any(leaf.flags.writeable for leaf in leaves if isinstance(leaf, np.ndarray))


def test_options_of_a_runner_are_copies():
    speed = np.full((1, DOF), 3.0)
    options = RunnerOptions(ROBOT, N, speed_limit=speed)
    speed[:] = 0.0
    np.testing.assert_array_equal(options.speed_limit, 3.0)


INPUTS = ("setpoint", "measurement", "measurement_rate", "setpoint_rate", "feedforward")
LAWS = {
    "plain": {},
    "all": {
        "derivative_filter_time": 0.01,
        "setpoint_weight": 0.5,
        "setpoint_weight_derivative": 0.5,
        "effort_rate_limit": 1e3,
        "continuous": True,
        "non_finite": "hold",
    },
}


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("backend", ["numpy", pytest.param("jax", marks=pytest.mark.slow)])
@settings(max_examples=3, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), rates=st.booleans(), data=st.data())
def test_a_controller_keeps_nothing_of_the_callers(law, backend, seed, rates, data):
    calls = data.draw(
        st.lists(st.sampled_from(["call", "reset", "track", "params"]), min_size=3, max_size=6)
    )
    efforts = [efforts_of(law, backend, calls, seed, rates, disturb) for disturb in (False, True)]
    np.testing.assert_array_equal(*efforts)


def efforts_of(law, backend, calls, seed, rates, disturb):
    rng = np.random.default_rng(seed)
    envs, joints = 128, 4  # JAX takes over large and aligned arrays without a copy

    def draw():
        gains_ = bp.make_params(
            joints, kp=rng.uniform(1, 9, (envs, joints)), ki=2.0, kd=0.5, **LAWS[law]
        )
        return own(gains_)

    params = draw()
    pid = bp.BatchPID(params, envs, 0.01, backend)
    efforts = []
    for call in ["call", *calls, "call", "call"]:
        if disturb:
            scribble(params)
        rows = {name: rng.normal(size=(envs, joints)) for name in INPUTS}
        if not rates:
            rows = {name: rows[name] for name in INPUTS[:2]}
        mask = rng.random(envs) < 0.5
        if call == "call":
            efforts.append(np.array(pid(**rows)))
        elif call == "reset":
            pid.reset(rows["measurement"], mask)
        elif call == "track":
            rows["effort"] = rng.normal(size=(envs, joints))
            pid.track(**rows)
        else:
            params = draw()
            pid.params = params
        if disturb:
            scribble(rows)
            scribble(mask)
    return np.array(efforts)


@pytest.mark.parametrize("law", LAWS)
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=10, deadline=None)
def test_the_functions_of_law_guard_and_actuators_keep_nothing(law, seed):
    rng = np.random.default_rng(seed)
    rows = [rng.normal(size=(3, 2)) for _ in range(3)]
    params = bp.make_params(2, kp=3.0, ki=2.0, kd=0.5, **LAWS[law])
    state = bp.init(params, rows[0])
    guarded = bp.make_guard(2, rate=1.0, acceleration=5.0)
    guard = bp.motors.guard.init(guarded, rows[0])
    real = bp.make_actuators(2, lag=0.1, command_delay=0.02, sensor_delay=0.01, backlash=0.1)
    motor = bp.motors.init(real, rows[0], 0.01)
    state, effort = bp.step(params, state, *rows[:2], 0.01, feedforward=rows[2])
    guard, _ = bp.motors.guard.advance(guarded, guard, rows[0], 0.01)
    motor, delivered = bp.motors.deliver(real, motor, rows[0], rows[1], rows[2], 0.01)
    motor, qpos, qvel = bp.motors.measure(real, motor, rows[0], rows[1], 0.01)
    state = bp.reset(params, state, rows[2], np.array([True, False, True]))
    kept = (*state, effort, *guard, *motor, delivered, qpos, qvel)
    copies = [np.array(leaf) for leaf in kept]
    scribble(rows)
    for one, other in zip(copies, kept, strict=True):
        np.testing.assert_array_equal(one, other)
