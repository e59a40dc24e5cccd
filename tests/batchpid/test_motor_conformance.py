"""Every executor of guard, friction, motors and sensors agrees with scalar_motors.py, for any
combination of options.

Executors are NumPy on read-only arrays, JAX, and native programs, which are bit-identical to NumPy.
"""

from __future__ import annotations

import re

import jax
import numpy as np
import pytest
from law_cases import read_only
from quick_jit import quick_jit
from scalar_motors import ScalarFriction, ScalarGuard, ScalarMotor, friction_gains

import batchpid as bp
from batchpid import motors
from batchpid.motors import friction, guard
from batchpid.native.array_program import ArrayProgram, obstacle
from batchpid.native.tracing import trace

DT, STEPS, ENVS, JOINTS = 1 / 500, 40, 5, 3
SHAPE = ENVS, JOINTS


def drawn(rng, ranges, dtype):
    """Return options of any combination, (envs, joints) each, in a third of the entries with the
    value that is off.
    """
    chosen = {name: each for name, each in ranges.items() if rng.random() < 0.7}
    return {
        name: (
            np.where(rng.random(SHAPE) < 0.3, off, on * rng.uniform(0.2, 1.0, SHAPE)).astype(dtype)
        )
        for name, (off, on) in chosen.items()
    }


def entry(options, env, joint):
    """Return the options of one joint, as plain numbers."""
    return {name: value[env, joint].item() for name, value in options.items()}


GUARD = {
    "lower": (-np.inf, -2.0),
    "upper": (np.inf, 2.0),
    "rate": (np.inf, 5.0),
    "acceleration": (np.inf, 60.0),
}
FRICTION = {"viscous": (0.0, 3.0), "static": (0.0, 3.0), "stribeck": (0.0, 0.5), "load": (0.0, 0.3)}
MOTORS = {
    "command_delay": (0.0, 0.012),
    "sensor_delay": (0.0, 0.009),
    "lag": (0.0, 0.01),
    "strength": (1.0, 0.9),
    "bias": (0.0, 0.5),
    "effort_limit": (np.inf, 12.0),
    "position_offset": (0.0, 0.1),
    "backlash": (0.0, 0.3),
    "position_resolution": (0.0, 0.01),
    "velocity_resolution": (0.0, 0.1),
}
"""Options that are numbers: the value that is off, and one that has an effect."""


class GuardCase:
    """A guard of setpoints that move and jump."""

    def __init__(self, rng, dtype):
        self.options = drawn(rng, GUARD, dtype) | {"continuous": rng.random(SHAPE) < 0.4}
        self.start = rng.uniform(-2, 2, SHAPE).astype(dtype)
        jumps = np.repeat(rng.normal(0, 2.5, (STEPS // 8, *SHAPE)), 8, axis=0)
        motion = DT * rng.normal(0, 3.0, SHAPE) * np.arange(STEPS)[:, None, None]
        self.inputs = [(jumps + motion).astype(dtype)]
        self.model = bp.make_guard(JOINTS, **self.options, dtype=dtype)

    def begin(self, model, start):
        return guard.init(model, start)

    def step(self, model, state, asked):
        state, changed = guard.advance(model, state, asked, DT)
        return state, (state.setpoint, changed)

    def oracle(self, env, joint):
        scalar = ScalarGuard(self.start[env, joint].item(), **entry(self.options, env, joint))
        for (asked,) in self.rows(env, joint):
            setpoint = scalar.step(asked, DT)
            yield setpoint, setpoint != asked

    def rows(self, env, joint):
        return zip(*(each[:, env, joint].tolist() for each in self.inputs), strict=True)


class FrictionCase(GuardCase):
    """Joints with friction under efforts and velocities that change sign."""

    def __init__(self, rng, dtype):
        self.options = {
            "coulomb": (
                np.where(rng.random(SHAPE) < 0.3, 0.0, rng.uniform(0.2, 2, SHAPE)).astype(dtype)
            )
        }
        self.options |= drawn(rng, FRICTION, dtype)
        root = rng.normal(size=(ENVS, JOINTS, JOINTS))
        self.mass = (0.02 * (root @ root.transpose(0, 2, 1) + np.eye(JOINTS))).astype(dtype)
        self.start = rng.normal(size=SHAPE).astype(dtype)
        self.load = rng.normal(size=SHAPE).astype(dtype)
        scale = np.array([3.0, 0.3])[:, None, None, None]
        self.inputs = list((scale * rng.normal(size=(2, STEPS, *SHAPE))).astype(dtype))
        self.model = friction.Friction(**self.options)

    def begin(self, model, start):
        return friction.init(model, start, 0 * start + self.load, self.mass, DT)

    def step(self, model, state, effort, velocity):
        state, total = friction.advance(model, state, effort, velocity)
        return state, (total,)

    def oracle(self, env, joint):
        own = {name: value[env].astype(float) for name, value in self.options.items()}
        rubs = sum(own.get(name, 0.0) for name in ("coulomb", "static", "load")) > 0
        mass = self.mass[env].astype(float)
        gains, shares = friction_gains(mass, own.get("viscous", np.zeros(JOINTS)), rubs, DT)
        begin = self.start[env, joint].item(), self.load[env, joint].item()
        options = entry(self.options, env, joint) | (
            {"slides": True} if "static" not in own else {}
        )
        scalar = ScalarFriction(*begin, gains[joint], shares[joint], **options)
        for row in self.rows(env, joint):
            yield (scalar.step(*row),)
            scalar.slides |= "static" not in own


class MotorCase(GuardCase):
    """Motors and sensors with every effect but noise."""

    def __init__(self, rng, dtype):
        self.options = drawn(rng, MOTORS, dtype) | {"continuous": rng.random(SHAPE) < 0.4}
        if rng.random() < 0.6:
            self.options |= {
                "saturation_effort": rng.uniform(5, 20, SHAPE),
                "no_load_speed": rng.uniform(2, 9, SHAPE),
            }
        self.model = bp.make_actuators(JOINTS, **self.options, dtype=dtype)
        velocity = 4 * rng.normal(size=(STEPS, *SHAPE))
        position = np.cumsum(0.1 * rng.normal(size=(STEPS + 1, *SHAPE)), axis=0)
        self.start = position[0].astype(dtype)
        self.inputs = [
            each.astype(dtype)
            for each in (10 * rng.normal(size=(STEPS, *SHAPE)), position[1:], velocity)
        ]
        self.samples = motors.init(self.model, self.start, DT)

    def begin(self, model, start):
        lengths = [leaf.shape[1] for leaf in self.samples if leaf is not None and leaf.ndim == 3]
        return motors.init(model, start, DT, samples=lengths[0] if lengths else None)

    def step(self, model, state, effort, qpos, qvel, k=None):
        k = motors.discretise(model, state, DT, ENVS) if k is None else k
        state, *seen = motors.advance_measurement(k, state, qpos, qvel)
        state, delivered = motors.advance_effort(k, state, effort, qpos, qvel)
        return state, (*seen, delivered)

    def oracle(self, env, joint):
        scalar = ScalarMotor(self.start[env, joint].item(), **entry(self.options, env, joint))
        for effort, qpos, qvel in self.rows(env, joint):
            seen = scalar.measure(qpos, qvel, DT)
            yield (*seen, scalar.deliver(effort, qpos, qvel, DT))


def by_numpy(case, dtype):
    model = type(case.model)(
        *(leaf if leaf is None else read_only(leaf, leaf.dtype) for leaf in case.model)
    )
    state, found = case.begin(model, read_only(case.start, dtype)), []
    for row in zip(*case.inputs, strict=True):
        state, seen = case.step(model, state, *(read_only(each, dtype) for each in row))
        found.append(seen)
    return found


def by_jax(case, dtype):
    model, step = jax.tree.map(jax.numpy.asarray, case.model), quick_jit(case.step)
    state, found = quick_jit(case.begin)(model, jax.numpy.asarray(case.start)), []
    for row in zip(*case.inputs, strict=True):
        state, seen = step(model, state, *row)
        assert all(each.dtype in (dtype, bool) for each in seen)
        found.append(seen)
    return found


def by_programs(case, dtype):
    """Guard and friction, each traced as a whole."""
    state, found = case.begin(case.model, case.start), []
    constants = [leaf for leaf in case.model if leaf is not None]
    kept = [leaf for leaf in state if leaf is not None]

    def function(*arrays):
        rest = iter(arrays)
        model, begun = (
            type(each)(*(None if leaf is None else next(rest) for leaf in each))
            for each in (case.model, state)
        )
        new, seen = case.step(model, begun, *rest)
        return [*(leaf for leaf in new if leaf is not None), *seen]

    inputs = len(kept) + len(case.inputs)
    program = ArrayProgram(
        trace(function, len(constants), inputs, dtype), constants, inputs, SHAPE, dtype
    )
    for row in zip(*case.inputs, strict=True):
        results = program(*kept, *row)
        kept, seen = [each.copy() for each in results[: len(kept)]], results[len(kept) :]
        found.append(seen)
    return found


CASES = {"guard": GuardCase, "friction": FrictionCase, "motors": MotorCase}
EXECUTORS = {"numpy": (by_numpy, 12), "programs": (by_programs, 8), "jax": (by_jax, 1)}
ROWS = [
    (case, name, seed)
    for case in CASES
    for name, (_, seeds) in EXECUTORS.items()
    for seed in range(seeds)
    if (case, name) != ("motors", "programs")  # tests/sim/test_conformance.py
]


@pytest.mark.parametrize(("case", "name", "seed"), ROWS)
def test_signals_are_those_of_plain_numbers(case, name, seed, request):
    is_narrow = name == "jax" or (name == "numpy" and seed % 2)
    # Friction sticks or slides by rounding.
    dtype = np.float32 if is_narrow and case != "friction" else np.float64
    if name == "programs" and obstacle():
        pytest.skip("there are no native programs")
    if name == "jax" and dtype == np.float64:
        request.getfixturevalue("x64")
    made = CASES[case](np.random.default_rng(seed), dtype)
    run, _ = EXECUTORS[name]

    def signals(rows):
        """Return the signals (signals, steps, envs, joints)."""
        found = [[np.broadcast_to(np.asarray(each, float), SHAPE) for each in row] for row in rows]
        return np.moveaxis(np.array(found), 0, 1)

    found = signals(run(made, dtype))
    wanted = np.array(
        [[list(made.oracle(env, joint)) for joint in range(JOINTS)] for env in range(ENVS)], float
    )
    wanted = np.moveaxis(wanted, (3, 2), (0, 1))
    tolerance = (
        1e-9 if dtype == np.float64 else 2e-3
    )  # a resolution, or the last step to a setpoint, may round away
    np.testing.assert_allclose(found, wanted, rtol=tolerance, atol=tolerance)
    if name == "programs":
        np.testing.assert_array_equal(found, signals(by_numpy(made, dtype)))


@pytest.mark.parametrize("form", ["one robot under vmap", "rows"])
def test_robots_do_not_need_each_other(form, x64):
    """Arrays (joints,) in and out under vmap, or (envs, joints): the same numbers, and devices that
    share the envs do not communicate.
    """
    rng, envs = np.random.default_rng(0), 8
    options, limits, rubs = (
        {name: on * rng.uniform(0.2, 1.0, JOINTS) for name, (_, on) in ranges.items()}
        for ranges in (MOTORS, GUARD, FRICTION)
    )
    actuators = bp.make_actuators(
        JOINTS, **options, continuous=[True, False, True], velocity_noise=0.01
    )
    limits = bp.make_guard(JOINTS, **limits)
    shape = (JOINTS,) if "vmap" in form else (1, JOINTS)
    rubs = {name: row.reshape(shape) for name, row in rubs.items()}
    rubs = friction.Friction(coulomb=rng.uniform(0.2, 2.0, shape), **rubs)

    def start(env, qpos):
        rest = 0 * qpos
        masses = np.broadcast_to(np.eye(JOINTS), (*qpos.shape, JOINTS))
        return (
            guard.init(limits, qpos),
            motors.init(actuators, qpos, DT, envs=env, samples=9),
            friction.init(rubs, rest, rest, masses, DT),
        )

    def step(state, now):
        guards, motor, rubbing = state
        asked, qpos, qvel = now
        guards, _ = guard.advance(limits, guards, asked, DT)
        motor, *seen = motors.measure(actuators, motor, qpos, qvel, DT)
        motor, effort = motors.deliver(actuators, motor, guards.setpoint, qpos, qvel, DT)
        rubbing, total = friction.advance(rubs, rubbing, effort, qvel)
        return (guards, motor, rubbing), (*seen, effort, total)

    def rollout(env, qpos, inputs):
        return jax.lax.scan(step, start(env, qpos), inputs)[1]

    inputs = rng.normal(0, 2.0, (STEPS, 3, envs, JOINTS))
    qpos = rng.normal(size=(envs, JOINTS))
    state, expected = start(np.arange(envs), qpos), []
    for row in inputs:
        state, seen = step(state, row)
        expected.append(seen)

    program = rollout if form == "rows" else jax.vmap(rollout, (0, 0, 2), 1)
    mesh = jax.sharding.Mesh(np.array(jax.devices()), "envs")
    assert mesh.size == 4
    places = [jax.sharding.PartitionSpec(*[None] * at, "envs") for at in (0, 0, 2)]
    arrays = [
        jax.device_put(array, jax.sharding.NamedSharding(mesh, place))
        for array, place in zip((np.arange(envs), qpos, inputs), places, strict=True)
    ]
    compiled = jax.jit(program).lower(*arrays).compile()
    for ours, theirs in zip(compiled(*arrays), zip(*expected, strict=True), strict=True):
        np.testing.assert_allclose(ours, np.array(theirs), rtol=1e-9, atol=1e-9)
        assert len(ours.sharding.device_set) == 4
    assert not re.search("all-|collective", compiled.as_text())
