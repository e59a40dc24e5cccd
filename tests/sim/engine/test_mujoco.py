"""MuJoCo as an engine: the same motion as in SAPIEN, and features of MuJoCo alone."""

import sys

import numpy as np
import pytest
from identical import assert_identical
from tiny_urdf import INERTIAL, joint, link, one_joint, robot, write

import batchpid as bp
from batchpid.errors import MissingDependencyError
from batchpid.sim import MujocoSolver, Robot, Runner
from batchpid.sim.engine.protocol import load_engine
from batchpid.sim.robot.robot_options import scene_of

pytestmark = pytest.mark.filterwarnings("ignore::batchpid.sim.StabilityWarning")


def test_a_link_named_world_and_a_floating_base(tmp_path):
    path = write(tmp_path, one_joint().replace('"base"', '"world"'))
    for fixed_base in (True, False):
        arm = Robot.load(path, fixed_base=fixed_base)
        with Runner(arm, 1, engine="mujoco", workers=0, ground=False) as runner:
            assert runner.step([0.1]).ok.all()
            assert (runner.observe().base_pose is None) == fixed_base


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


def test_drives_of_each_env_keep_their_gains_beside_motors(panda):
    """Motors change the joints of the models, after which envs with equal models share one."""

    def run_drives(*stiffness):
        params = panda.params(kp=np.outer(stiffness, np.ones(panda.dof)), ki=0.0, kd=10.0)
        options = {
            "actuators": bp.make_actuators(panda.dof, armature=0.05),
            "params": params,
            "control": "drive",
        }
        with Runner(panda, len(stiffness), engine="mujoco", workers=0, **options) as runner:
            runner.reset()
            for _ in range(10):
                obs = runner.step(np.clip(panda.start + 0.1, panda.lower, panda.upper))
            return obs

    both = run_drives(50.0, 200.0)
    for env, stiffness in enumerate((50.0, 200.0)):
        assert_identical(run_drives(stiffness), both.for_envs(slice(env, env + 1)))


def test_solver_settings_are_those_given(panda):
    with Runner(panda, 1, workers=0, engine="mujoco", physics=MujocoSolver(iterations=7)) as runner:
        assert runner.options.solver.iterations == 7


def test_without_mujoco_the_error_names_the_package(panda, monkeypatch):
    monkeypatch.delitem(sys.modules, "batchpid.sim.engine.mujoco.mujoco_pack", raising=False)
    monkeypatch.setitem(sys.modules, "mujoco.batch", None)
    with pytest.raises(MissingDependencyError, match="mujoco"):
        Runner(panda, 1, workers=0, engine="mujoco")


def test_a_state_that_is_not_finite_is_the_loops_to_report(capfd):
    """MuJoCo's own warning would name no env."""
    engine = load_engine("mujoco")
    legs = Robot.load("quadruped", fixed_base=False)  # a robot that MuJoCo steps, in any state
    pack = engine.make_pack(scene_of(legs, 5e-4, engine.physics["accurate"]), 1)
    states = pack.read_state()
    pack.write_state_rows(np.full_like(states, np.nan))
    assert np.isnan(pack.read_qpos()).all()
    pack.write_state_rows(states)
    assert np.isfinite(pack.read_qpos()).all()
    assert capfd.readouterr().err == ""
