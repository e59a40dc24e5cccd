"""Sim steps of a tick in one native call: the same motion as in NumPy, independent of the other envs of a group."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from identical import assert_identical
from robots import load_bundled

import batchpid as bp
import batchpid.task_space as ts
from batchpid.motors import friction as friction_model
from batchpid.sim import Randomization, Robot, Runner, Uniform
from batchpid.sim.engine import native
from batchpid.sim.engine.coupled_joints import ConstraintEfforts
from batchpid.sim.engine.native_model import NativeModel, NativeRefresh
from batchpid.sim.engine.physics import PHYSICS
from batchpid.sim.engine.protocol import Friction, SceneSpec, Variation, load_engine
from batchpid.sim.engine.robot_model import passive_force, scene_tree
from batchpid.sim.loop.native_executor import NativeExecutor
from batchpid.sim.loop.native_ticks import NativeTicks
from batchpid.sim.loop.numpy_executor import NumPyExecutor
from tests.sim.engine.test_coupled_joints import arm

pytestmark = pytest.mark.skipif(bool(native.obstacle()), reason="native calls are not available")
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
    found = NativeModel(spec).mass_matrix(poses)
    np.testing.assert_allclose(found, ts.mass_matrix(scene_tree(spec).held, poses), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("parts", [(True, True), (True, False), (False, True)], ids=str)
@pytest.mark.parametrize("name", ["panda", "jaco2"])
def test_the_passive_force_is_that_of_the_model(name, parts):
    robot = load_bundled(name)
    poses, rates = robot.sample(21, seed=0), np.random.default_rng(0).normal(size=(21, robot.dof))
    spec = SceneSpec(robot.urdf, robot.ignored_pairs, robot.joints, 1e-3, PHYSICS["fast"])
    force = NativeModel(spec).passive_force(poses, rates, *parts)
    wanted = passive_force(scene_tree(spec).held, poses, rates, *parts)
    assert np.abs(wanted).max() > 0.01
    np.testing.assert_allclose(force, wanted, rtol=1e-10, atol=1e-10)
    for row in range(21):
        alone = NativeModel(spec).passive_force(poses[row : row + 1], rates[row : row + 1], *parts)
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


EFFECTS = {
    "command_delay": 0.004,
    "lag": 0.004,
    "strength": 1.0,
    "bias": 0.2,
    "effort_limit": 60.0,
    "saturation_effort": 90.0,
    "coulomb": 0.5,
    "static": 0.4,
    "stribeck": 0.05,
    "load_friction": 0.1,
    "armature": 0.05,
    "position_offset": 0.01,
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
    if "static" in effects:
        effects["static"] = effects["static"] + effects.get("coulomb", 0.0)
    else:
        effects.pop("stribeck", None)
    if "saturation_effort" in effects:
        effects["no_load_speed"] = 4.0
    if control != "drive" and rng.random() < 0.5:
        effects["position_limit"] = np.array([-1.0, 0.0, 1.0]), np.array([40.0, 80.0, 60.0])
    options = {"control": control, "actuators": bp.make_actuators(robot.dof, **effects, seed=7)}
    options["compensate"] = str(rng.choice(["gravity+coriolis+friction", "gravity", "none"]))
    options["guard"] = bool(control in ("pid", "drive") and rng.random() < 0.5)
    if control == "drive":
        options["params"] = robot.params(gain_units="effort", kp=300.0, ki=float(rng.choice([0.0, 50.0])), kd=30.0)
    else:
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


@pytest.mark.parametrize(
    "actuators",
    [{}, {"command_delay": 0.002, "strength": 0.95, "effort_limit": 60.0, "coulomb": 0.3}],
    ids=str,
)
def test_python_calls_of_a_sim_step(panda, actuators):
    """Their number does not grow with the sim steps of a tick; 64 pandas are four groups."""
    pytest.importorskip("mujoco")  # where a possible contact ends no call
    calls = 0

    def count(frame, event, argument):
        nonlocal calls
        calls += event == "call" and "/workers/" not in frame.f_code.co_filename

    motors = bp.make_actuators(panda.dof, **actuators)
    with Runner(panda, 64, workers=0, actuators=motors, engine="mujoco") as runner:
        target = np.tile(panda.settings.target, (64, 1))
        for _ in range(4):
            runner.step(target)
        found = []
        for substeps in (20, 200):  # friction takes new inertias every 64 sim steps
            sys.setprofile(count)
            try:
                runner.step(target, substeps=substeps)
            finally:
                sys.setprofile(None)
            found.append(calls)
            calls = 0
    assert found[0] == found[1] <= 4 * 20 + 60, "60 for the runner itself"


class Rest:
    """A controller that only compensates the passive force."""

    def init(self, robot, num_envs):
        return None

    def __call__(self, state, setpoint, qpos, qvel, passive):
        return state, passive


def test_control_steps_that_are_a_program(panda):
    """All except with an own controller."""
    effects = {"command_delay": 0.002, "strength": 0.95, "position_noise": 1e-4}
    gains = {"gain_units": "effort", "kp": 300.0, "kd": 30.0}
    cases = {
        "ideal": {},
        "actuators": {"actuators": bp.make_actuators(panda.dof, **effects)},
        "payload": {"randomization": Randomization(payload=Uniform(0.0, 1.0))},
        "drive": {"control": "drive", "params": panda.params(**gains, ki=0.0)},
        "integral": {"control": "drive", "params": panda.params(**gains, ki=50.0)},
        "guard": {"control": "drive", "params": panda.params(**gains, ki=0.0), "guard": True},
        "controller": {"control": Rest()},
    }
    executors, programs = [], set()

    class Seen(NativeExecutor):
        def run(self, *arguments):
            executors.append(self._compiles)
            return super().run(*arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("batchpid.sim.loop.env_group.NativeExecutor", Seen)
        for case, options in cases.items():
            with Runner(panda, 2, workers=0, **options) as runner:
                runner.step(panda.settings.target)
            programs |= {case} if executors[-1] else set()
    assert programs == cases.keys() - {"controller"}


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
        ({"control": "drive"}, ""),
        ({"control": "drive", "guard": True}, ""),
        ({"actuators": bp.make_actuators(9, coulomb=0.5)}, ""),
        ({"control": "osc", "tool": "panda_hand", "actuators": bp.make_actuators(9, coulomb=0.5)}, ""),
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
        "drive",
        "drive with guard",
        "coulomb",
        "tool with friction",
        "tool",
        "tool with sensors",
    ],
)
def test_the_backend_says_why_a_tick_is_not_one_native_call(options, reason, panda, monkeypatch):
    check_calls(panda, options, reason, monkeypatch)


def counted_calls(monkeypatch):
    """Return lists to which native calls append their sim steps, and draws of noise."""
    spans, draws, run, draw = [], [], NativeTicks.run, NativeTicks._draw

    def counted(self, step, tick, begin, until, steps, whole):
        end, done, status = run(self, step, tick, begin, until, steps, whole)
        spans.append((end - tick) * steps + done - begin)
        return end, done, status

    def drawn(self):
        draws.append(1)
        return draw(self)

    monkeypatch.setattr(NativeTicks, "run", counted)
    monkeypatch.setattr(NativeTicks, "_draw", drawn)
    return spans, draws


def check_calls(robot, options, reason, monkeypatch):
    """Check the number of native calls in a tick of 100 sim steps, and the reason for more of them."""
    spans, noise = counted_calls(monkeypatch)
    with Runner(robot, 2, workers=0, **options) as runner:
        begin = runner.reset()
        runner.step(begin.qpos if begin.tool_pose is None else begin.tool_pose, substeps=100)
        assert sum(spans) == (0 if reason else 100)
        assert len(spans) <= 1
        noisy = "actuators" in options and options["actuators"].position_noise is not None
        assert len(noise) <= (4 if noisy else len(spans)), "the noise of sensors is drawn for 64 sim steps"
        assert ("a call each sim step (" in runner.backend) == bool(reason)
        assert reason in runner.backend


def test_a_tick_of_coupled_joints_is_one_native_call(tmp_path, engine, monkeypatch):
    check_calls(arm(tmp_path, joints=3), {"engine": engine}, "", monkeypatch)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"compensate": "none", "actuators": bp.make_actuators(9, position_noise=1e-4)},
        {"actuators": bp.make_actuators(9, position_noise=1e-4)},
        {"randomization": Randomization(payload=Uniform(0.1, 0.2))},
    ],
    ids=["pid", "no compensation", "sensors", "masses"],
)
@pytest.mark.filterwarnings("ignore::batchpid.sim.FaultWarning")
def test_a_tick_on_a_floating_base_is_one_native_call(options, engine, monkeypatch):
    options = {"engine": engine, "ground": False, **options}
    check_calls(Robot.load("panda", fixed_base=False), options, "", monkeypatch)


def varied_pack(robot, engine):
    """Return a pack of 5 robots, with payloads and masses of links that differ."""
    chosen, rng = load_engine(engine), np.random.default_rng(0)
    spec = SceneSpec(
        robot.urdf,
        robot.ignored_pairs,
        robot.joints,
        5e-4,
        next(iter(chosen.physics.values())),
        fixed_base=robot.fixed_base,
        engine=engine,
        ground=False,
    )
    variation = Variation(payload=rng.uniform(0.5, 3.0, 5), link_mass=rng.uniform(0.5, 2.0, (5, 2)))
    return chosen.make_pack(spec, 5, 0, variation, "panda_hand", ["panda_link2", "panda_link7"]), variation


@pytest.mark.parametrize("fixed_base", [True, False])
def test_the_joint_mass_matrix_of_varied_masses_is_that_of_the_engine_model(engine, fixed_base, monkeypatch):
    robot = Robot.load("panda", fixed_base=fixed_base)
    found = []
    for switch in ("1", "0"):
        monkeypatch.setenv(native.SWITCH, switch)
        pack, variation = varied_pack(robot, engine)
        assert pack.steps_natively == (switch == "1")
        poses = robot.sample(5, seed=1)
        matrices = [pack.joint_mass_matrix(poses)]
        pack.vary([1, 3], Variation(payload=np.array([0.1, 0.2]), link_mass=variation.link_mass[:2].copy()))
        matrices.append(pack.joint_mass_matrix(poses))
        found.append(np.array(matrices))
        pack.close()
    assert not np.allclose(found[0][0, 1], found[0][1, 1], rtol=1e-3)
    scale = np.abs(found[1]).max()
    np.testing.assert_allclose(found[0], found[1], rtol=0, atol=(2e-6 if engine == "sapien" else 1e-12) * scale)


@pytest.mark.parametrize("coupled", [False, True])
def test_the_refresh_of_friction_is_that_of_the_friction_model(panda, tmp_path, coupled):
    robot = arm(tmp_path, -0.5, 0.01, joints=3) if coupled else panda
    spec = SceneSpec(robot.urdf, robot.ignored_pairs, robot.joints, 1e-3, PHYSICS["fast"])
    rng, shape = np.random.default_rng(0), (7, robot.dof)
    model, qpos, coupling = NativeModel(spec), robot.sample(7, seed=0), robot.coupling
    armature, drive = rng.uniform(0, 0.1, shape), tuple(rng.uniform(0, 100.0, (2, *shape)))
    state = friction_model.started(np.zeros(shape), np.zeros(shape))
    matrix = model.mass_matrix(qpos) + armature[:, None] * np.eye(robot.dof)
    matrix = coupling.mass_matrix(matrix)
    coulomb = rng.uniform(0, 1, shape) * (rng.random(shape) < 0.7)
    for friction in (Friction(coulomb), Friction(coulomb[:1], rng.uniform(0, 1, shape))):
        for given in ((0.0, 0.0), drive):
            ours = NativeRefresh(model, 7, armature, friction, given, coupling, 1e-3, 64)(state, qpos)
            theirs = friction_model.refresh(friction, state, matrix, 1e-3, *given)
            np.testing.assert_allclose(ours.gain, theirs.gain, rtol=1e-10, atol=1e-12)
            np.testing.assert_allclose(ours.memory, theirs.memory, rtol=1e-10, atol=1e-12)
            assert (theirs.gain > 0).any()
            assert (theirs.gain == 0).any()


def test_the_update_of_a_constraint_is_that_of_numpy(tmp_path):
    """Also for a robot that has failed, and for some robots only."""
    robot = arm(tmp_path, -0.5, 0.01, joints=3)
    spec = SceneSpec(robot.urdf, robot.ignored_pairs, robot.joints, 1e-3, PHYSICS["fast"])
    model, qpos, rng = NativeModel(spec), robot.sample(6, seed=0), np.random.default_rng(0)
    qpos[4, 1] = np.nan
    effort, passive, rate = rng.normal(size=(3, 6, robot.dof))
    results = []
    for natively in (True, False):
        constraint = ConstraintEfforts(6, robot.coupling, robot.continuous, 1e-3)
        constraint.implicit[...] = 0.01
        if natively:
            constraint.use(model, None)
        constraint.update(model.mass_matrix, qpos, passive, [0, 1, 2, 4])
        results.append(constraint.apply(effort, np.nan_to_num(qpos), rate))
    np.testing.assert_allclose(*results, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(results[0][[3, 5]], effort[[3, 5]])
