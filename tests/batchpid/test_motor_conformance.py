"""Every executor of guard, friction, motors and sensors agrees with scalar_motors.py, for any
combination of options.

Executors are NumPy on read-only arrays, JAX, and native programs, which are bit-identical to NumPy.
"""

import functools
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

DT, STEPS, ENVS, JOINTS = 1 / 500, 40, 4, 3
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
}
"""Options that are numbers: the value that is off, and one that has an effect."""


class GuardCase:
    """A guard of setpoints that move and jump."""

    def __init__(self, rng, dtype):
        self.options = drawn(rng, GUARD, dtype) | {"continuous": rng.random(SHAPE) < 0.4}
        self.begins = [rng.uniform(-2, 2, SHAPE).astype(dtype)]
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
        (start,) = self.begins
        scalar = ScalarGuard(start[env, joint].item(), **entry(self.options, env, joint))
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
        mass = 0.02 * (root @ root.transpose(0, 2, 1) + np.eye(JOINTS))
        begins = [rng.normal(size=SHAPE), rng.normal(size=SHAPE), mass]
        self.begins = [rows.astype(dtype) for rows in begins]
        scale = np.array([3.0, 0.3])[:, None, None, None]
        self.inputs = list((scale * rng.normal(size=(2, STEPS, *SHAPE))).astype(dtype))
        self.model = friction.Friction(**self.options)

    def begin(self, model, start, load, mass):
        return friction.init(model, start, load, mass, DT)

    def step(self, model, state, effort, velocity):
        state, total = friction.advance(model, state, effort, velocity)
        return state, (total,)

    def oracle(self, env, joint):
        own = {name: value[env].astype(float) for name, value in self.options.items()}
        rubs = sum(own.get(name, 0.0) for name in ("coulomb", "static", "load")) > 0
        start, load, mass = (rows[env].astype(float) for rows in self.begins)
        gains, shares = friction_gains(mass, own.get("viscous", np.zeros(JOINTS)), rubs, DT)
        options = entry(self.options, env, joint) | (
            {"slides": True} if "static" not in own else {}
        )
        scalar = ScalarFriction(start[joint], load[joint], gains[joint], shares[joint], **options)
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
        self.begins = [position[0].astype(dtype)]
        inputs = 10 * rng.normal(size=(STEPS, *SHAPE)), position[1:], velocity
        self.inputs = [rows.astype(dtype) for rows in inputs]
        self.longest = self.model.max_delay
        self.model = self.model._replace(max_delay=None)

    def begin(self, model, start):
        return motors.init(model._replace(max_delay=self.longest), start, DT)

    def step(self, model, state, effort, qpos, qvel):
        k = motors.discretise(model.for_rank(qpos.ndim), state, DT)
        state, *seen = motors.advance_measurement(k, state, qpos, qvel)
        state, delivered = motors.advance_effort(k, state, effort, qvel)
        return state, (*seen, delivered)

    def oracle(self, env, joint):
        (start,) = self.begins
        scalar = ScalarMotor(start[env, joint].item(), **entry(self.options, env, joint))
        for effort, qpos, qvel in self.rows(env, joint):
            seen = scalar.measure(qpos, qvel, DT)
            yield (*seen, scalar.deliver(effort, qpos, qvel, DT))


def by_numpy(case, dtype):
    model = type(case.model)(
        *(leaf if leaf is None else read_only(leaf, leaf.dtype) for leaf in case.model)
    )
    state, found = case.begin(model, *(read_only(rows, dtype) for rows in case.begins)), []
    for row in zip(*case.inputs, strict=True):
        state, seen = case.step(model, state, *(read_only(each, dtype) for each in row))
        found.append(seen)
    return found


def by_jax(case, dtype, alone=False):
    """A scan on devices that share the envs without communicating; ``alone``: of one robot under
    vmap.
    """

    def rollout(model, begins, inputs):
        def step(state, now):
            return case.step(model, state, *now)

        return jax.lax.scan(step, case.begin(model, *begins), inputs)[1]

    model = case.model
    if alone and hasattr(model, "for_rank"):  # (1, joints), as made for one robot
        model = jax.tree.map(lambda rows: rows[:, None], model)
    arguments = [model, case.begins, case.inputs]
    assert len(jax.devices()) == 4
    mesh = jax.sharding.Mesh(np.array(jax.devices()), "envs")
    places = [jax.sharding.PartitionSpec(*[None] * at, "envs") for at in (0, 0, 1)]
    shardings = [jax.sharding.NamedSharding(mesh, place) for place in places]
    arrays = jax.device_put(arguments, shardings)
    program = jax.vmap(rollout, (0, 0, 1), 1) if alone else rollout
    compiled = quick_jit(program).lower(*arrays).compile()
    assert not re.search("all-|collective", compiled.as_text())
    found = compiled(*arrays)
    for each in found:
        assert len(each.sharding.device_set) == 4
        assert each.dtype in (dtype, bool)
    return zip(*found, strict=True)


def by_programs(case, dtype):
    """Guard and friction, each traced as a whole."""
    state, found = case.begin(case.model, *case.begins), []
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
EXECUTORS = {
    "numpy": (by_numpy, 12),
    "programs": (by_programs, 8),
    "jax": (by_jax, 1),
    "jax alone": (functools.partial(by_jax, alone=True), 1),
}
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
    if "jax" in name and dtype == np.float64:
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


def test_every_field_is_tried():
    """But for noise, whose seed and moments have tests of their own; armature is the simulator's."""
    fields = {*bp.Guard._fields, *friction.Friction._fields, *bp.Actuators._fields}
    for case in CASES.values():
        for seed in range(6):
            fields -= case(np.random.default_rng(seed), np.float64).options.keys()
    others = {"armature", "load_friction", "max_delay", "turns"}  # continuous
    assert fields == {"position_noise", "velocity_noise", "seed"} | others
