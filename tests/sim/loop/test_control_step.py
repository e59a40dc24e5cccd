"""The control step: pure, one for all executors, the same on NumPy and JAX."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from identical import assert_identical

import batchpid as bp
from batchpid.motors import discretise
from batchpid.motors import guard as guard_model
from batchpid.motors.coupling import Coupling, Follower
from batchpid.motors.friction import init as init_friction
from batchpid.sim import Runner
from batchpid.sim.engine.protocol import Friction
from batchpid.sim.loop import control_step as module
from batchpid.sim.loop import xla_executor
from batchpid.sim.loop.arrays import Command
from batchpid.sim.loop.control_step import control_step
from batchpid.sim.loop.pid_law import PIDLaw
from batchpid.sim.loop.step_values import Constants, KnownFriction, Layout, Measured, Model, Step, StepState

DT, ENVS, JOINTS = 1e-3, 4, 3
MATRIX = np.diag([2.0, 1.0, 0.5]) + 0.1


def mass_matrix(qpos):
    xp = qpos.__array_namespace__()
    return xp.asarray(MATRIX) * (1.5 + xp.cos(qpos[:, :1]))[:, :, None]


def table(rng, scale=1.0):
    return scale * rng.normal(size=(ENVS, JOINTS))


EFFECTS = ("guard", "motors", "friction", "known", "feedforward", "rate", "acceleration")


def a_step(control, units, effects, seed, coupled=False):
    """Return the arguments of a control step with these effects, at a random state."""
    rng = np.random.default_rng(seed)
    params = bp.make_params(JOINTS, 30.0, ki=20.0, kd=2.0, effort_limit=25.0, gain_units=units)
    model = Model(mass_matrix, mass_matrix)
    layout = Layout(control, PIDLaw.of(params) if control == "pid" else None, model=model)
    qpos, qvel, passive = table(rng), table(rng), table(rng, 3.0)
    coupling = Coupling.of(JOINTS, [Follower(2, 0, 0.5, 0.1)] if coupled else [])
    constants = Constants(DT, (params.effort_min, params.effort_max), coupling=coupling)
    state = StepState(bp.init(params, qpos), matrix=mass_matrix(qpos) if units == "mass_matrix" else None)
    if units == "inertia":
        state = state._replace(matrix=np.einsum("ejj->ej", mass_matrix(qpos)).copy())
    if control == "pid":
        constants = constants._replace(k=bp.discretise(params, DT, ENVS))
    if "guard" in effects:
        guard = bp.make_guard(JOINTS, rate=0.5, acceleration=40.0)
        constants, state = constants._replace(guard=guard), state._replace(guard=guard_model.init(guard, qpos))
    if "motors" in effects:
        motors = bp.make_actuators(
            JOINTS, command_delay=2.5e-3, lag=0.01, strength=0.9, backlash=1e-3, effort_limit=9.0
        )
        started = bp.motors.init(motors, qpos, DT)
        layout = layout._replace(measures=motors.measures)
        constants = constants._replace(motors=discretise(motors, started, DT, ENVS))
        state = state._replace(motors=started)
    if "friction" in effects:
        friction = Friction(np.full((1, JOINTS), 0.7), np.full((1, JOINTS), 0.2))
        rubbing = init_friction(friction, qvel, passive, mass_matrix(qpos), DT)
        age = rng.integers(60, 65, ENVS)
        constants, state = constants._replace(friction=friction), state._replace(friction=rubbing, age=age)
    if "known" in effects:
        constants = constants._replace(known=KnownFriction(np.full(JOINTS, 0.5), np.full(JOINTS, 1e-3), None))
    command = Command(
        qpos + table(rng, 0.1),
        table(rng, 0.1) if "rate" in effects else None,
        table(rng, 0.1) if {"rate", "acceleration"} <= effects else None,
        table(rng) if "feedforward" in effects else None,
    )
    return layout, constants, state, command, Measured(qpos, qvel, passive)


def run(layout, constants, state, command, measured, steps=6, end=10, function=control_step):
    for index in range(steps):
        state, outputs = function(layout, constants, state, command, measured, Step(index, end))
        measured = measured._replace(qpos=measured.qpos + 1e-3 * measured.qvel, qvel=measured.qvel + 1e-4 * outputs.qf)
    return state, outputs


def leaves(tree):
    if tree is None or isinstance(tree, np.ndarray):
        return [] if tree is None else [tree]
    return [leaf for part in tree for leaf in leaves(part)] if isinstance(tree, tuple) else []


CASES = st.tuples(
    st.sampled_from(["pid", "effort"]),
    st.sampled_from([None, "inertia", "mass_matrix"]),
    st.sets(st.sampled_from(EFFECTS)),
    st.integers(0, 1000),
)


@settings(max_examples=30)
@given(CASES, st.booleans())
def test_it_writes_to_nothing(case, coupled):
    arguments = a_step(case[0], case[1] or "effort", *case[2:], coupled)
    for leaf in leaves(arguments[1:]):
        leaf.flags.writeable = False
    before = [leaf.copy() for leaf in leaves(arguments[1:])]
    first, second = run(*arguments), run(*arguments)
    for leaf, copy in zip(leaves(arguments[1:]), before, strict=True):
        np.testing.assert_array_equal(leaf, copy)
    for one, other in zip(leaves(first), leaves(second), strict=True):
        np.testing.assert_array_equal(one, other)


@settings(max_examples=30)
@given(CASES, st.permutations(range(ENVS)))
def test_envs_do_not_see_each_other(case, order):
    arguments = a_step(case[0], case[1] or "effort", case[2] - {"motors"}, case[3])
    layout, constants, state, command, measured = arguments
    _, outputs = run(*arguments)

    def permuted(tree):
        if isinstance(tree, np.ndarray):
            return tree[order] if tree.shape[0] == ENVS else tree
        parts = [permuted(part) for part in tree] if isinstance(tree, tuple) else tree
        return tree if tree is None or not isinstance(tree, tuple) else type(tree)(*parts)

    _, moved = run(layout, constants, permuted(state), permuted(command), permuted(measured))
    np.testing.assert_array_equal(moved.qf, outputs.qf[order])
    np.testing.assert_array_equal(moved.saturated, outputs.saturated[order])


@settings(max_examples=6)
@given(CASES)
def test_jax_runs_the_same_function(case):
    import jax
    from quick_jit import quick_jit

    arguments = a_step(case[0], case[1] or "effort", *case[2:])

    def when(due, function, otherwise):
        return jax.lax.cond(jax.numpy.asarray(due).any(), function, lambda: otherwise)

    with jax.enable_x64(True):
        traced = arguments[0]._replace(model=Model(mass_matrix, mass_matrix, when=when))
        step = quick_jit(lambda *inputs: control_step(traced, *inputs[:-1], Step(inputs[-1], 10)))
        state, outputs = run(*arguments, function=lambda _, *inputs: step(*inputs[:-1], inputs[-1].index))
        expected_state, expected = run(*arguments)
        pairs = zip(jax.tree.leaves((state, outputs)), jax.tree.leaves((expected_state, expected)), strict=True)
        for ours, theirs in pairs:
            np.testing.assert_allclose(np.asarray(ours), theirs, rtol=1e-9, atol=1e-12)


def final(robot, switch, backend, monkeypatch, **options):
    """Return the positions after a tick with a feedforward, by the executor of these settings."""
    monkeypatch.setenv("BATCHPID_NATIVE", switch)
    with Runner(robot, 2, workers=0, substeps=6, backend=backend, **options) as runner:
        return runner.step(robot.settings.target, feedforward=np.full(robot.dof, 2.0)).qpos


EXECUTORS = {"numpy": ("0", "numpy"), "native": ("1", "numpy"), "xla": ("1", "jax")}


def swap(monkeypatch, first, second):
    """Exchange two stages of the table."""
    names = [stage.name for stage in module.STAGES]
    i, j = names.index(first), names.index(second)
    table = list(module.STAGES)
    table[i], table[j] = table[j], table[i]
    monkeypatch.setattr(module, "STAGES", tuple(table))


@pytest.mark.usefixtures("quick_compilation")
def test_every_executor_runs_the_order_of_the_table(panda, monkeypatch):
    """A feedforward after the law has no effect in its sim step."""
    given = {"actuators": bp.make_actuators(panda.dof, strength=0.8, coulomb=0.5)}
    before = {name: final(panda, *each, monkeypatch) for name, each in EXECUTORS.items()}
    moving = {name: final(panda, *EXECUTORS[name], monkeypatch, **given) for name in ("numpy", "native")}
    xla_executor.compiled.cache_clear()
    with monkeypatch.context() as patch:
        swap(patch, "feedforward", "law")
        after = {name: final(panda, *each, monkeypatch) for name, each in EXECUTORS.items()}
    xla_executor.compiled.cache_clear()
    for name in EXECUTORS:
        assert np.abs(after[name] - before[name]).max() > 1e-5, name
        np.testing.assert_allclose(after[name], after["numpy"], rtol=0, atol=1e-6)
    swap(monkeypatch, "motors", "friction")
    changed = {name: final(panda, *EXECUTORS[name], monkeypatch, **given) for name in moving}
    for name in moving:
        assert np.abs(changed[name] - moving[name]).max() > 1e-7, name
        np.testing.assert_allclose(changed[name], changed["numpy"], rtol=0, atol=1e-6)


def test_the_documentation_has_the_stages_in_their_order():
    lines = module.__doc__.split("in this order::")[1].split("The executors")[0].splitlines()
    named = [line.strip() for line in lines if line.strip()]
    assert len(named) == len(module.STAGES)
    for line, stage in zip(named, module.STAGES, strict=True):
        assert line.startswith(stage.name)


@pytest.mark.usefixtures("quick_compilation")
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_a_program_of_xla_goes_on_from_a_snapshot_in_either_precision(panda, dtype):
    table = panda.settings.target + 0.01 * np.sin(np.arange(6.0))[:, None, None] - np.full((6, 2, 1), 0.012)
    with Runner(panda, 2, workers=0, backend="jax", dtype=dtype) as runner:
        runner.rollout(table[:3])
        snapshot = runner.snapshot()
        first = runner.rollout(table[3:])
        runner.restore(snapshot)
        assert_identical(first, runner.rollout(table[3:]))


def test_the_feedforward_of_one_tick_does_not_act_in_the_next(panda):
    """Under control "drive", without compensation, nothing else is written to the joints."""
    params = panda.params(kp=0.0, ki=0.0, kd=0.0)
    with Runner(panda, 1, workers=0, control="drive", compensate="none", params=params) as runner:
        runner.step(panda.start, feedforward=np.full(panda.dof, 2.0))
        assert (runner.step(panda.start).effort == 0).all()
