"""Sim steps of a tick in one native call: the same motion as in NumPy, independent of the other envs of a group."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from identical import assert_identical
from robots import load_bundled

import batchpid as bp
from batchpid.sim import Randomization, Robot, Runner, Uniform
from batchpid.sim.engine import native
from batchpid.sim.engine.batch_dynamics import NativeMassMatrix, NativePassiveForce
from batchpid.sim.engine.sapien.physics import PHYSICS
from batchpid.sim.engine.scene_spec import SceneSpec
from batchpid.sim.loop import native_executor, tick_program
from batchpid.sim.loop.control_step import control_step
from batchpid.sim.loop.native_executor import NativeExecutor
from batchpid.sim.loop.numpy_executor import NumPyExecutor
from batchpid.sim.loop.tick_program import TickProgram
from tests.sim.engine.test_coupled_joints import arm

pytestmark = pytest.mark.skipif(not native.status().active, reason="native calls are not available")
N = 3
CASES = {
    "tuned": {},
    "inertia": {"gain_units": "inertia", "kp": 400.0, "ki": 100.0, "kd": 40.0},
    "implicit": {"gain_units": "mass_matrix", "discretization": "implicit", "kp": 4e4, "ki": 1e6, "kd": 400.0},
    "without units": {"gain_units": "effort", "kp": 300.0, "ki": 50.0, "kd": 30.0},
}


def params_of(robot, case):
    return robot.params(**CASES[case]) if CASES[case] else None


def rollout(robot, ticks=20, rates=False, forward=False, **options):
    rng = np.random.default_rng(0)
    middle = np.clip(robot.settings.target, robot.lower + 0.05, robot.upper - 0.05)
    path = np.clip(middle + np.cumsum(0.01 * rng.normal(size=(ticks, N, robot.dof)), 0), robot.lower, robot.upper)
    more = {"setpoint_rates": np.gradient(path, 0.01, axis=0)} if rates else {}
    more |= {"feedforwards": 0.1 * rng.normal(size=path.shape)} if forward else {}
    with Runner(robot, N, workers=0, **options) as runner:
        return runner.rollout(path, **more)


AHEAD, GUARD = {"rates": True, "forward": True}, {"guard": True}


@pytest.mark.quick_rows(5)
@pytest.mark.parametrize(
    ("name", "case", "more"),
    [
        *(("panda", case, {}) for case in CASES),
        *(("jaco2", case, AHEAD) for case in CASES),
        *(("panda", "tuned", GUARD), ("jaco2", "implicit", GUARD), ("panda", "without units", AHEAD)),
    ],
    ids=str,
)
def test_the_motion_is_that_of_numpy(name, case, more, monkeypatch):
    robot = load_bundled(name)
    options = {"params": params_of(robot, case), **more}
    ours = rollout(robot, **options)
    monkeypatch.setenv(native.SWITCH, "0")
    theirs = rollout(robot, **options)
    assert np.ptp(theirs.qpos, axis=0).max() > 0.05
    np.testing.assert_allclose(ours.qpos, theirs.qpos, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(ours.saturated, theirs.saturated)
    np.testing.assert_array_equal(ours.guarded, theirs.guarded)
    assert theirs.guarded.any() == ("guard" in more)


@pytest.mark.parametrize("name", ["panda", "jaco2"])
def test_the_mass_matrix_is_that_of_the_model(name):
    robot = load_bundled(name)
    poses = robot.sample(50, seed=0)
    spec = SceneSpec(robot.urdf, robot.ignored_pairs, robot.joints, 1e-3, PHYSICS["fast"])
    np.testing.assert_allclose(NativeMassMatrix(spec)(poses), robot.dynamics().mass_matrix(poses), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("parts", [(True, True), (True, False), (False, True)], ids=str)
@pytest.mark.parametrize("name", ["panda", "jaco2"])
def test_the_passive_force_is_that_of_the_model(name, parts):
    robot = load_bundled(name)
    poses, rates = robot.sample(21, seed=0), np.random.default_rng(0).normal(size=(21, robot.dof))
    spec = SceneSpec(robot.urdf, robot.ignored_pairs, robot.joints, 1e-3, PHYSICS["fast"])
    force = NativePassiveForce(spec)(poses, rates, *parts)
    wanted = robot.dynamics().passive_force(poses, rates, *parts)
    assert np.abs(wanted).max() > 0.01
    np.testing.assert_allclose(force, wanted, rtol=1e-5, atol=1e-6)  # SAPIEN's model is float32
    for row in range(21):
        alone = NativePassiveForce(spec)(poses[row : row + 1], rates[row : row + 1], *parts)
        np.testing.assert_array_equal(alone[0], force[row])


def test_an_env_that_is_reset_changes_no_other(panda):
    """A reset puts friction and mass matrix of one env out of step with the others', which then stop for it."""
    table = np.tile(panda.settings.target, (3, N, 1)) - 0.01
    found = []
    for mask in (np.zeros(N, bool), np.arange(N) == 1):
        with Runner(panda, N, workers=0, substeps=21) as runner:
            runner.rollout(table)
            if mask.any():
                runner.reset(mask=mask)
            found.append(runner.rollout(table))
    assert_identical(*found, np.arange(N) != 1)
    assert not np.array_equal(found[0].qpos[:, 1], found[1].qpos[:, 1])


def test_the_program_is_a_trace_of_the_control_step(panda, monkeypatch):
    calls = []

    def recorded(layout, *arguments):
        calls.append(layout.control)
        return control_step(layout, *arguments)

    assert native_executor.control_step is tick_program.control_step is control_step
    monkeypatch.setattr(tick_program, "control_step", recorded)
    tick_program._trace.cache_clear()
    with Runner(panda, 2, workers=0, substeps=30) as runner:
        runner.step(panda.settings.target)
    tick_program._trace.cache_clear()
    assert calls == ["pid"], "traced once; friction is not due within 64 sim steps"


EFFECTS = {
    "command_delay": 0.004,
    "lag": 0.004,
    "strength": 1.0,
    "bias": 0.2,
    "effort_limit": 60.0,
    "saturation_effort": 90.0,
    "coulomb": 0.5,
    "armature": 0.05,
    "sensor_delay": 0.003,
    "backlash": 0.001,
    "position_resolution": 1e-4,
    "velocity_resolution": 1e-3,
    "position_noise": 1e-4,
    "velocity_noise": 1e-3,
}


def random_options(robot, rng):
    """Return options with about half of the effects, controls and variations, each number drawn per env and joint."""
    control = str(rng.choice(["pid", "pid", "effort", "drive"]))
    names = [name for name in EFFECTS if rng.random() < 0.5 and (control != "drive" or name in ("coulomb", "armature"))]
    effects = {name: EFFECTS[name] * rng.uniform(0.2, 1.0, (N, robot.dof)) for name in names}
    if "saturation_effort" in effects:
        effects["no_load_speed"] = 4.0
    if control != "drive" and rng.random() < 0.5:
        effects["position_limit"] = np.array([-1.0, 0.0, 1.0]), np.array([40.0, 80.0, 60.0])
    options = {"control": control, "actuators": bp.make_actuators(robot.dof, **effects, seed=7)}
    options["compensate"] = str(rng.choice(["gravity+coriolis+friction", "gravity", "none"]))
    if control == "drive":
        options["params"] = robot.params(gain_units="effort", kp=300.0, ki=0.0, kd=30.0)
    else:
        options["guard"] = bool(control == "pid" and rng.random() < 0.5)
        options["params"] = params_of(robot, rng.choice(list(CASES))) if control == "pid" else None
    if rng.random() < 0.5:
        options["randomization"] = Randomization(payload=Uniform(0.0, 2.0), friction=Uniform(0.0, 0.5))
    return {name: value for name, value in options.items() if value is not None}


def leaves(tree):
    """Yield the arrays of nested named tuples, dicts and dataclasses."""
    if isinstance(tree, np.ndarray):
        yield tree
    elif isinstance(tree, dict):
        yield from (leaf for each in tree.values() for leaf in leaves(each))
    elif hasattr(tree, "__dict__") or hasattr(tree, "_asdict"):
        yield from leaves(tree._asdict() if hasattr(tree, "_asdict") else vars(tree))


def check_against_numpy(robot, engine, seed):
    """Check rollouts, a reset of one env between them, and a snapshot."""
    options, found = random_options(robot, np.random.default_rng(seed)), []
    rng = np.random.default_rng(seed)
    path = np.clip(robot.start + np.cumsum(0.02 * rng.normal(size=(6, N, robot.dof)), 0), robot.lower, robot.upper)
    if options["control"] == "effort":
        path = 5.0 * rng.normal(size=path.shape)
    for executor in (NativeExecutor, NumPyExecutor):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("batchpid.sim.loop.env_group.NativeExecutor", executor)
            with Runner(robot, N, workers=0, substeps=23, engine=engine, **options) as runner:
                rollouts = [runner.rollout(path[:4])]
                runner.reset(mask=np.arange(N) == 1)
                rollouts.append(runner.rollout(path[4:]))
                found.append((rollouts, runner.snapshot().states))
    for ours, theirs in zip(found[0][0], found[1][0], strict=True):
        assert_identical(ours, theirs)
    for mine, other in zip(leaves(found[0][1]), leaves(found[1][1]), strict=True):
        np.testing.assert_array_equal(mine, other)


@pytest.mark.parametrize("seed", range(4))
def test_random_settings_give_the_bytes_of_numpy(panda, engine, seed):
    check_against_numpy(panda, engine, seed)


@pytest.mark.quick_rows(2)
@pytest.mark.parametrize("seed", range(10, 30))
def test_random_settings_of_coupled_joints_give_the_bytes_of_numpy(tmp_path, engine, seed):
    check_against_numpy(arm(tmp_path, -0.5, 0.01, joints=3), engine, seed)


@pytest.mark.quick_rows(2)
@pytest.mark.parametrize("seed", range(30, 50))
@pytest.mark.filterwarnings("ignore::batchpid.sim.FaultWarning")
def test_random_settings_on_a_floating_base_give_the_bytes_of_numpy(engine, seed):
    check_against_numpy(Robot.load("panda", fixed_base=False), engine, seed)


@pytest.mark.slow
def test_many_random_settings_give_the_bytes_of_numpy(panda, engine):
    for seed in range(100, 200):
        check_against_numpy(panda, engine, seed)


@pytest.mark.parametrize("actuators", [{}, {"command_delay": 0.002, "strength": 0.95, "effort_limit": 60.0}], ids=str)
def test_python_calls_of_a_sim_step(panda, actuators):
    """At most two for each group of envs and sim step; 64 pandas are four groups."""
    calls = 0

    def count(frame, event, argument):
        nonlocal calls
        calls += event == "call" and "/workers/" not in frame.f_code.co_filename

    motors = bp.make_actuators(panda.dof, **actuators)
    with Runner(panda, 64, workers=0, substeps=20, actuators=motors) as runner:
        target = np.tile(panda.settings.target, (64, 1))
        for _ in range(4):
            runner.step(target)
        sys.setprofile(count)
        try:
            runner.step(target)
        finally:
            sys.setprofile(None)
    assert calls <= 2 * 4 * 20 + 60, "60 for the runner itself"


def test_coupled_joints_take_a_call_for_four_sim_steps(tmp_path, engine, monkeypatch):
    spans, run, run_ticks = [], TickProgram.run, TickProgram.run_ticks

    def counted(self, step, begin, until, end):
        spans.append((begin, until))
        return run(self, step, begin, until, end)

    def counted_ticks(self, step, transfers, first, until, steps):
        spans.extend([steps] * (until - first))
        return run_ticks(self, step, transfers, first, until, steps)

    monkeypatch.setattr(TickProgram, "run", counted)
    monkeypatch.setattr(TickProgram, "run_ticks", counted_ticks)
    with Runner(arm(tmp_path, joints=3), 2, workers=0, engine=engine) as runner:
        start = runner.reset().qpos
        runner.step(start, substeps=10)
        assert spans == [(0, 4), (4, 8), (8, 10)]
        assert "a call each sim step" not in runner.backend


class Rest:
    """A controller that only compensates the passive force."""

    def init(self, robot, num_envs):
        return None

    def __call__(self, state, setpoint, qpos, qvel, passive):
        return state, passive


def test_control_steps_that_are_a_program(panda):
    """Not those of an own controller, nor of drives whose targets move within a tick."""
    effects = {"command_delay": 0.002, "strength": 0.95, "position_noise": 1e-4}
    gains = {"gain_units": "effort", "kp": 300.0, "kd": 30.0}
    cases = {
        "ideal": {},
        "actuators": {"actuators": bp.make_actuators(panda.dof, **effects)},
        "payload": {"randomization": Randomization(payload=Uniform(0.0, 1.0))},
        "drive": {"control": "drive", "params": panda.params(**gains, ki=0.0)},
        "integral": {"control": "drive", "params": panda.params(**gains, ki=50.0)},
        "controller": {"control": Rest()},
    }
    executors, programs = [], set()

    class Seen(NativeExecutor):
        def run(self, *arguments):
            executors.append(self._compiles)
            return super().run(*arguments)

        def run_ticks(self, *arguments):
            executors.append(self._compiles)
            return super().run_ticks(*arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("batchpid.sim.loop.env_group.NativeExecutor", Seen)
        for case, options in cases.items():
            with Runner(panda, 2, workers=0, **options) as runner:
                runner.step(panda.settings.target)
            programs |= {case} if executors[-1] else set()
    assert programs == cases.keys() - {"integral", "controller"}


@pytest.mark.usefixtures("engine")
@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({}, ""),
        ({"control": "effort"}, ""),
        ({"actuators": bp.make_actuators(9, strength=0.9, viscous=0.1)}, ""),
        ({"actuators": bp.make_actuators(9, position_noise=1e-4)}, ""),
        ({"compensate": "gravity"}, ""),
        ({"randomization": Randomization(friction=Uniform(0.1, 0.2))}, ""),
        ({"randomization": Randomization(payload=Uniform(0.1, 0.2))}, ""),
        ({"control": Rest()}, "the controller is one of Python"),
        ({"control": "osc", "tool": "panda_hand"}, ""),
        ({"control": "osc", "tool": "panda_hand", "actuators": bp.make_actuators(9, position_noise=1e-4)}, ""),
    ],
    ids=[
        "pid",
        "effort",
        "motors",
        "sensors",
        "gravity",
        "friction",
        "masses",
        "controller",
        "tool",
        "tool with sensors",
    ],
)
def test_the_backend_says_why_a_tick_is_not_one_native_call(options, reason, panda, monkeypatch):
    """Runs of the program, of the whole tick or of one sim step, are counted."""
    spans, run, run_ticks = [], TickProgram.run, TickProgram.run_ticks

    def counted(self, step, begin, until, end):
        spans.append(until - begin)
        return run(self, step, begin, until, end)

    def counted_ticks(self, step, transfers, first, until, steps):
        spans.extend([steps] * (until - first))
        return run_ticks(self, step, transfers, first, until, steps)

    monkeypatch.setattr(TickProgram, "run", counted)
    monkeypatch.setattr(TickProgram, "run_ticks", counted_ticks)
    with Runner(panda, 2, workers=0, **options) as runner:
        begin = runner.reset()
        runner.step(begin.qpos if begin.tool_pose is None else begin.tool_pose, substeps=10)
        assert (spans == [10]) == (not reason)
        assert ("a call each sim step (" in runner.backend) == bool(reason)
        assert reason in runner.backend


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({}, ""),
        ({"compensate": "none", "actuators": bp.make_actuators(9, position_noise=1e-4)}, ""),
        ({"actuators": bp.make_actuators(9, position_noise=1e-4)}, "a sensor's reading"),
        ({"randomization": Randomization(payload=Uniform(0.1, 0.2))}, "varied masses"),
    ],
    ids=["pid", "no compensation", "sensors", "masses"],
)
def test_the_reasons_on_a_floating_base(options, reason):
    with Runner(Robot.load("panda", fixed_base=False), 2, workers=0, **options) as runner:
        assert ("a call each sim step (" in runner.backend) == bool(reason)
        assert reason in runner.backend
