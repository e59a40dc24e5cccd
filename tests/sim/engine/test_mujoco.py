"""MuJoCo as an engine: the model that is built, the same motion as in SAPIEN, and the promises of a runner."""

import ctypes
import dataclasses
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco")
pytest.importorskip("mujoco.batch")

from identical import assert_identical  # noqa: E402
from robots import RUBBING, load_bundled  # noqa: E402
from tiny_urdf import INERTIAL, joint, link, one_joint, random_tree, robot, write  # noqa: E402

import batchpid as bp  # noqa: E402
from batchpid.errors import InvalidArgumentError, MissingDependencyError  # noqa: E402
from batchpid.sim import (  # noqa: E402
    FaultWarning,
    MujocoSolver,
    Physics,
    Randomization,
    Robot,
    Runner,
    Uniform,
)
from batchpid.sim.engine import native, protocol  # noqa: E402
from batchpid.sim.engine.mujoco import model_builder  # noqa: E402
from batchpid.sim.engine.mujoco.model_builder import _set_options, robot_model  # noqa: E402
from batchpid.sim.engine.mujoco.mujoco_step import CLOCK, mujoco_library  # noqa: E402
from batchpid.sim.engine.protocol import SceneSpec, load_engine  # noqa: E402
from batchpid.sim.engine.robot_model import scene_model  # noqa: E402
from batchpid.sim.observation import OBSERVED  # noqa: E402
from batchpid.sim.tuning import arm_joints, random_moves, run_moves, tutorial_move  # noqa: E402

SCALE = Uniform(0.8, 1.2, operation="scale")
pytestmark = pytest.mark.filterwarnings("ignore::batchpid.sim.StabilityWarning")


def spec_of(of: Robot, engine: str = "mujoco", **changes) -> SceneSpec:
    physics = load_engine(engine).physics["accurate"]
    spec = SceneSpec(of.urdf, of.ignored_pairs, of.joints, 5e-4, physics, fixed_base=of.fixed_base, engine=engine)
    return dataclasses.replace(spec, **changes)


def run(engine="mujoco", name="panda", num_envs=6, ticks=20, rows=slice(None), **options):
    """Run to setpoints that depend on the env; return the last observation."""
    arm = load_bundled(name) if isinstance(name, str) else name
    setpoints = arm.start + 0.2 * np.sin(np.arange(arm.dof) + np.arange(6)[:, None])
    setpoints = np.clip(setpoints, arm.lower, arm.upper)[rows]
    with Runner(arm, num_envs, engine=engine, **options) as runner:
        runner.reset()
        for _ in range(ticks):
            obs = runner.step(setpoints)
    assert np.abs(obs.qpos - arm.start).max() > 0.01
    return obs


def assert_same_env(alone, among, env):
    for name in OBSERVED:
        np.testing.assert_array_equal(getattr(alone, name)[0], getattr(among, name)[env], name)


# -- the model ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_dynamics_are_those_of_mujocos_own_reading_of_the_urdf(tmp_path, seed):
    path = write(tmp_path, robot(*random_tree(np.random.default_rng(seed), 12)))
    arm = Robot.load(path)
    model = mujoco.MjModel.from_xml_path(str(path))
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    qpos, qvel, qacc = rng.normal(size=(3, 20, arm.dof))
    ours = scene_model(spec_of(arm))
    order = [model.joint(name).dofadr[0] for name in arm.joint_names]
    for row in range(20):
        data.qpos[order], data.qvel[order], data.qacc[order] = qpos[row], qvel[row], qacc[row]
        mujoco.mj_inverse(model, data)
        full = np.empty((model.nv, model.nv))
        mujoco.mj_fullM(model, data, full)
        one = slice(row, row + 1)
        scale = np.abs(full).max()
        np.testing.assert_allclose(ours.mass_matrix(qpos[one])[0], full[np.ix_(order, order)], atol=1e-12 * scale)
        expected = data.qfrc_inverse[order]
        effort = ours.inverse_dynamics(qpos[one], qvel[one], qacc[one])
        np.testing.assert_allclose(effort[0], expected, atol=1e-12 * np.abs(expected).max())
        np.testing.assert_allclose(ours.forward_dynamics(qpos[one], qvel[one], effort)[0], qacc[row], atol=1e-9)


def test_the_native_mass_matrix_is_that_of_the_model(tmp_path):
    from batchpid.sim.engine.native_model import NativeModel

    tree = Robot.load(write(tmp_path, robot(*random_tree(np.random.default_rng(5), 12))))
    for arm in (load_bundled("panda"), load_bundled("jaco2"), tree):
        spec, qpos = spec_of(arm), arm.sample(20, seed=1)
        expected = scene_model(spec).mass_matrix(qpos)
        np.testing.assert_allclose(NativeModel(spec).mass_matrix(qpos), expected, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize("left_out", range(5))
def test_exactly_the_pairs_that_are_ignored_do_not_collide(tmp_path, left_out):
    """Of three bodies that overlap, one of two links; each pair of links in turn is left to collide."""
    box = INERTIAL + '<collision><geometry><box size="0.4 0.4 0.4"/></geometry></collision>'
    weld = '<joint name="weld" type="fixed"><parent link="arm"/><child link="tip"/><origin xyz="0 0 0.1"/></joint>'
    parts = [link("base", INERTIAL), link("arm", box), link("tip", box), weld, link("side", box), link("back", box)]
    parts += [joint(child, "base", child) for child in ("arm", "side", "back")]
    arm = Robot.load(write(tmp_path, robot(*parts)), self_collision="urdf")
    pairs = [("arm", "side"), ("tip", "side"), ("arm", "back"), ("tip", "back"), ("side", "back")]
    touching = {frozenset(pairs.pop(left_out))}
    model = robot_model(spec_of(arm, ignored=tuple(pairs), ground=False)).model
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    found = [[model.body(model.geom_bodyid[geom]).name.split()[0] for geom in each.geom] for each in data.contact]
    assert {frozenset(pair) for pair in found} == touching


def test_a_link_named_world_and_a_floating_base(tmp_path):
    text = one_joint().replace('"base"', '"world"')
    for fixed_base in (True, False):
        model = robot_model(spec_of(Robot.load(write(tmp_path, text), fixed_base=fixed_base))).model
        assert model.nv == (1 if fixed_base else 7)


# -- the motion --------------------------------------------------------------------------------------------------------


@pytest.mark.quick_rows(3)
@pytest.mark.parametrize(
    ("name", "options", "tolerance"),
    [
        ("panda", {}, 1e-5),
        pytest.param("panda", {"compensate": "gravity"}, 1e-4, marks=pytest.mark.slow),
        ("panda", {"control": "drive"}, 1e-5),
        ("panda", {"collisions": False}, 1e-5),
        ("jaco2", {}, 2e-4),
        pytest.param(RUBBING, {}, 1e-4, marks=pytest.mark.slow),
        ("panda", {"actuators": {"command_delay": 0.002, "armature": 0.1}}, 1e-4),
        ("panda", {"randomization": Randomization(payload=Uniform(0.0, 2.0), link_mass=SCALE)}, 1e-4),
        *(
            pytest.param("panda", {"randomization": randomization}, 1e-4, marks=pytest.mark.slow)
            for randomization in (
                Randomization(center_of_mass=Uniform(-0.02, 0.02)),
                Randomization(damping=Uniform(0.0, 2.0), armature=Uniform(0.0, 0.1)),
            )
        ),
    ],
)
def test_a_robot_moves_as_in_sapien(name, options, tolerance):
    if isinstance(given := options.get("actuators"), dict):
        options = {"actuators": bp.make_actuators(load_bundled(name).dof, **given)}
    both = [run(engine, name, workers=0, physics="fast", ticks=40, **options) for engine in ("sapien", "mujoco")]
    np.testing.assert_allclose(both[0].qpos, both[1].qpos, atol=tolerance)
    assert all(obs.ok.all() for obs in both)


@pytest.mark.slow
def test_moves_under_tuned_gains_are_those_of_sapien(panda):
    moves = tutorial_move(panda) + random_moves(panda, 7, seed=1)

    def qpos(**options):
        with Runner(panda, 8, workers=0, **options) as runner:
            rollout, metrics = run_moves(runner, moves, 0.9)
            assert metrics.settling_time[:, arm_joints(panda)].max() < 0.8
            assert np.maximum(panda.lower - rollout.qpos, rollout.qpos - panda.upper).max() < 2e-3
            return rollout.qpos

    mine = qpos(engine="mujoco")
    np.testing.assert_allclose(mine, qpos(physics="fast"), rtol=0, atol=1e-4)
    np.testing.assert_allclose(mine, qpos(physics="accurate"), rtol=0, atol=5e-4)


def test_coupled_joints_move_as_in_sapien(tmp_path):
    mimic = (
        '<limit lower="-1" upper="1" effort="10" velocity="2"/><mimic joint="hinge" multiplier="-0.5" offset="0.1"/>'
    )
    parts = [link("base"), link("arm"), link("finger"), joint("hinge", "base", "arm")]
    arm = Robot.load(write(tmp_path, robot(*parts, joint("tip", "arm", "finger", inner=mimic))))
    both = []
    for engine in ("sapien", "mujoco"):
        with Runner(arm, 2, engine=engine, workers=0, ground=False) as runner:
            runner.reset()
            for _ in range(50):
                obs = runner.step([0.3, -0.05])
            both.append(obs.qpos)
    np.testing.assert_allclose(both[1][:, 1], 0.1 - 0.5 * both[1][:, 0], atol=1e-6)
    np.testing.assert_allclose(both[0], both[1], atol=1e-4)


@pytest.mark.parametrize("compensate", ["none", "gravity", "gravity+coriolis"])
@pytest.mark.parametrize("fixed_base", [True, False])
def test_a_branched_robot_moves_as_in_sapien(tmp_path, compensate, fixed_base):
    tree = robot(*random_tree(np.random.default_rng(2), 12))
    arm, both = Robot.load(write(tmp_path, tree), fixed_base=fixed_base), []
    for engine in ("sapien", "mujoco"):
        options = {"engine": engine, "workers": 0, "control": "effort", "ground": False, "compensate": compensate}
        with Runner(arm, 2, **options) as runner:
            runner.reset(np.full((2, arm.dof), 0.1), qvel=np.full((2, arm.dof), 0.3))
            for _ in range(10):
                obs = runner.step(np.full((2, arm.dof), 0.5))
            both.append(obs.qpos)
    np.testing.assert_allclose(both[0], both[1], atol=1e-5)


@pytest.mark.filterwarnings("ignore::batchpid.sim.SetpointWarning")
def test_joints_stop_at_their_limits(panda):
    """Within the travel of one sim step, and within 1e-4 rad where they rest under load."""
    with Runner(panda, 1, engine="mujoco", workers=0, substeps=1, compensate="none") as runner:
        runner.reset()
        for _ in range(1500):
            speed = 0.0 if runner.time == 0 else np.abs(obs.qvel).max()  # noqa: F821
            obs = runner.step(panda.upper + 0.5)
            beyond = np.maximum(panda.lower - obs.qpos, obs.qpos - panda.upper).max()
            assert beyond < 1e-4 + speed * runner.timestep
    assert beyond < 1e-4
    assert (obs.qpos[0, [0, 2, 4, 6]] > panda.upper[[0, 2, 4, 6]] - 1e-3).any()


def test_the_ground_holds_a_robot_that_falls_on_it(tmp_path):
    box = INERTIAL + '<collision><geometry><box size="0.4 0.4 0.4"/></geometry></collision>'
    text = robot(link("base", box), link("arm"), joint("hinge", "base", "arm", origin="0 0 0"))
    arm = Robot.load(write(tmp_path, text), fixed_base=False)
    with Runner(arm, 1, engine="mujoco", workers=0, ground=True) as runner:
        runner.reset()  # the box begins half within the ground
        for _ in range(50):
            obs = runner.step(np.zeros((1, 1)))
    assert obs.ok.all()
    assert abs(obs.qpos[0, 0]) < 0.05


# -- promises ----------------------------------------------------------------------------------------------------------


def test_drives_of_each_env_keep_their_gains_beside_motors(panda):
    """Motors change the joints of the models, after which envs with equal models share one."""

    def run_drives(*stiffness):
        params = panda.params(kp=np.outer(stiffness, np.ones(panda.dof)), ki=0.0, kd=10.0)
        options = {"actuators": bp.make_actuators(panda.dof, armature=0.05), "params": params, "control": "drive"}
        with Runner(panda, len(stiffness), engine="mujoco", workers=0, **options) as runner:
            runner.reset()
            for _ in range(10):
                obs = runner.step(np.clip(panda.start + 0.1, panda.lower, panda.upper))
            return obs

    both = run_drives(50.0, 200.0)
    for env, stiffness in enumerate((50.0, 200.0)):
        assert_same_env(run_drives(stiffness), both, env)


@pytest.mark.parametrize("randomization", [None, Randomization(payload=Uniform(0.1, 0.5))])
def test_drives_go_on_from_a_snapshot(panda, randomization):
    """Robots with drives have another model, with data of another size, than robots that have none yet."""
    options = {"params": panda.params(kp=100.0, ki=0.0, kd=10.0), "control": "drive", "randomization": randomization}
    with Runner(panda, 2, engine="mujoco", workers=0, **options) as runner:
        runner.reset(panda.settings.target)
        before = runner.snapshot()
        gone_on = runner.step(panda.start)
        runner.restore(before)
        again = runner.step(panda.start)
    for one, other in zip(gone_on[:3], again[:3], strict=True):
        np.testing.assert_array_equal(one, other)


def test_groups_that_share_their_working_memory_move_as_one_that_does_not(jaco2, monkeypatch):
    """Arms lie on the ground and their fingers touch, where the next step depends on the solver's warm start."""
    efforts = 0.02 * np.random.default_rng(0).normal(size=(60, 6, jaco2.dof)) * jaco2.effort_limit
    runs = []
    for size in (64, 2):
        monkeypatch.setattr(type(load_engine("mujoco")), "group_size", size)
        with Runner(jaco2, 6, engine="mujoco", workers=0, control="effort", compensate="none") as runner:
            runner.reset(jaco2.sample(6, seed=1))
            runs.append([runner.step(effort) for effort in efforts])
    for one, other in zip(*runs, strict=True):
        assert_identical(one, other)
    assert runs[0][-1].ok.all()


def test_mujocos_clock_goes_on_after_native_steps(panda):
    """They stop it while they run, in any thread."""

    def clock():
        return ctypes.c_void_p.in_dll(ctypes.CDLL(str(mujoco_library())), CLOCK).value

    before = clock()
    with (
        Runner(panda, 3, engine="mujoco", workers=0, substeps=50) as first,
        Runner(panda, 3, engine="mujoco", workers=0, substeps=50) as second,
        ThreadPoolExecutor() as pool,
    ):
        for runner in (first, second):
            runner.reset()
        for done in [pool.submit(runner.step, panda.settings.target) for runner in (first, second)]:
            done.result()
    assert clock() == before


def test_a_snapshot_of_the_other_engine_is_refused(panda):
    with Runner(panda, 1, workers=0) as one:
        snapshot = one.snapshot()
    with Runner(panda, 1, workers=0, engine="mujoco") as other, pytest.raises(InvalidArgumentError, match="engine"):
        other.restore(snapshot)


@pytest.mark.parametrize("switch", ["1", "0"], ids=["native", "Python"])
def test_an_error_of_mujoco_closes_the_runner(panda, monkeypatch, switch):
    def add_little_memory(scene, spec):
        _set_options(scene, spec)
        scene.memory = 10_000

    monkeypatch.setenv("BATCHPID_NATIVE", switch)
    monkeypatch.setattr(model_builder, "_set_options", add_little_memory)
    with Runner(panda, 2, engine="mujoco", workers=0, control="effort", timestep=4.9e-4) as runner:
        with pytest.raises(Exception, match="out of memory"):
            runner.rollout(np.full((100, 2, panda.dof), 3.0))
        assert runner.closed
    robot_model.cache_clear()


def test_a_state_that_is_not_finite_is_contained(panda, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    params = bp.make_params(panda.dof, kp=0.0, ki=0.0, kd=0.0)
    options = {"workers": 0, "engine": "mujoco", "control": "effort", "compensate": "none", "params": params}
    with Runner(panda, 3, **options) as runner:
        runner.reset()
        efforts = np.zeros((3, panda.dof))
        efforts[1] = 1e30
        with pytest.warns(FaultWarning):
            obs = runner.step(efforts)
        assert list(obs.ok) == [True, False, True]
        runner.reset(mask=np.array([False, True, False]))
        obs = runner.step(np.zeros((3, panda.dof)))
        assert obs.ok.all()
    assert not list(tmp_path.iterdir())  # MuJoCo's log


# -- errors ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"physics": Physics("PGS", 4)}, "physics.*'accurate'"),
        ({"build": lambda scene, env: None}, "build.*'sapien'"),
        ({"engine": "mujocoo"}, "engine.*'mujoco'"),
    ],
)
def test_options_without_meaning_are_refused(panda, options, message):
    with pytest.raises(InvalidArgumentError, match=message):
        Runner(panda, 1, **{"engine": "mujoco", "workers": 0} | options)


def test_the_solver_of_mujoco_is_refused_by_sapien(panda):
    with pytest.raises(InvalidArgumentError, match="physics"):
        Runner(panda, 1, workers=0, physics=MujocoSolver())
    with Runner(panda, 1, workers=0, engine="mujoco", physics=MujocoSolver(iterations=7)) as runner:
        assert runner.options.solver.iterations == 7


def test_the_backend_names_the_engine(panda):
    def backend(**options):
        with Runner(panda, 1, engine="mujoco", workers=0, **options) as runner:
            return runner.backend

    assert "calls into MuJoCo" in backend()
    assert backend(control="drive").startswith("law in MuJoCo")
    alone = backend(backend="jax", compensate="gravity")
    assert "call each sim step" in alone
    assert "into MuJoCo" in alone
    no_law = backend(backend="jax", compensate="gravity", control="effort")
    if not native.obstacle():
        assert no_law == "law as a native program, native calls into MuJoCo"


def test_sapiens_own_friction_is_refused():
    with pytest.raises(InvalidArgumentError, match="sapien_dissipation"):
        Runner(Robot.load("panda", dissipation="sapien"), 1, workers=0, engine="mujoco")


def test_without_mujoco_the_message_names_the_remedy(panda, monkeypatch):
    monkeypatch.delitem(sys.modules, protocol.MODULES["mujoco"], raising=False)
    monkeypatch.setitem(sys.modules, "mujoco.batch", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'mujoco>=3.17'"):
        load_engine("mujoco")
