"""StabilityWarning: a runner says once that its gains pass the stability bound, of which joint and by how much."""

from __future__ import annotations

import dataclasses
import warnings

import numpy as np
import pytest

import batchpid as bp
from batchpid.sim import Robot, Runner, StabilityWarning
from batchpid.sim.tuning import tune
from tests.sim.tiny_urdf import joint, link, one_joint, robot, write

BAD, GOOD = {"kp": 10.0, "ki": 0.0, "kd": [1.0, 5e4]}, {"kp": 10.0, "ki": 0.0, "kd": 1.0}


@pytest.fixture
def arm(tmp_path):
    return Robot.load(write(tmp_path, robot(*map(link, "abc"), joint("one", "a", "b"), joint("two", "b", "c"))))


def warned(call):
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        runner = call()
    seen = [each for each in seen if each.category is StabilityWarning]
    assert all(each.filename == __file__ for each in seen)
    return runner, [str(each.message) for each in seen]


def make(arm, num_envs=1, **options):
    return Runner(arm, num_envs, **{"workers": 0, "collisions": False} | options)


def test_it_names_joint_factor_and_remedy_at_construction_and_assignment(arm):
    runner, (message,) = warned(lambda: make(arm, params=arm.params(**BAD)))
    with runner:
        finding = next(one for one in arm.check(params=arm.params(**BAD)) if one.joint is None)
        factor = finding.text.split(" times")[0].rsplit(" ", 1)[1]
        assert f"gains are {factor} times the stability bound" in message
        assert "mostly of joint 'two', at the start pose with a time step of 0.0005 s" in message
        assert "use at most" in message
        assert finding.remedy.split(" times")[0] in message

        def assign(params):
            runner.params = params

        assert warned(lambda: assign(arm.params(**BAD)))[1] == []  # beyond as before
        assert warned(lambda: assign(arm.params(**GOOD)))[1] == []
        assert len(warned(lambda: assign(arm.params(**BAD)))[1]) == 1


def test_the_env_is_named_and_the_remedy_works(arm):
    kd = np.tile([1.0, 1.0], (5, 1))
    kd[3, 0] = 5e4
    runner, (message,) = warned(lambda: make(arm, 5, params=arm.params(kp=10.0, ki=0.0, kd=kd)))
    runner.close()
    assert "joint 'one', env 3" in message
    scale = float(message.split("use at most ")[1].split(" times")[0])
    runner, none = warned(lambda: make(arm, 5, params=arm.params(kp=10.0 * scale, ki=0.0, kd=kd * scale)))
    runner.close()
    assert none == []


@pytest.mark.parametrize(
    "options",
    [
        {"params": GOOD},
        {"params": BAD, "control": "drive"},
        {"params": BAD, "control": "effort"},
        {"params": BAD | {"derivative_filter_time": 10.0}},
        {"params": BAD, "actuators": {"strength": 1e-3}},
        {"params": GOOD, "actuators": {"command_delay": 0.01}},
        {"params": BAD, "actuators": {"armature": 100.0}},
    ],
    ids=str,
)
def test_there_is_none_within_the_bound_and_where_it_does_not_hold(arm, options):
    options = {**options, "params": arm.params(**options["params"])}
    if "actuators" in options:
        options["actuators"] = bp.make_actuators(2, **options["actuators"])
    runner, none = warned(lambda: make(arm, **options))
    runner.close()
    assert none == []


@pytest.mark.parametrize("late", ["command_delay", "sensor_delay"])
def test_motors_that_are_late_lower_the_bound(arm, late):
    """Gains within the bound of ideal motors; the env with late motors is named, and the remedy works."""
    delays = np.zeros((3, 2))
    delays[2] = 0.01
    bad, motors = {"kp": 500.0, "ki": 0.0, "kd": 300.0}, bp.make_actuators(2, **{late: delays})
    runner, none = warned(lambda: make(arm, 3, params=arm.params(**bad)))
    runner.close()
    assert none == []
    runner, (message,) = warned(lambda: make(arm, 3, params=arm.params(**bad), actuators=motors))
    runner.close()
    assert "env 2" in message
    assert "oscillates" in message
    real = dataclasses.replace(arm, actuators=motors.for_envs(slice(2, 3)))
    assert any(each.code == "unstable" for each in real.check(params=arm.params(**bad)))
    scale = float(message.split("use at most ")[1].split(" times")[0])
    good = {name: scale * gain for name, gain in bad.items()}
    runner, none = warned(lambda: make(arm, 3, params=arm.params(**good), actuators=motors))
    runner.close()
    assert none == []


def test_bundled_gains_do_not_warn(panda, jaco2):
    for each in (panda, jaco2):
        for params in (each.tuned(), *map(each.designed, ("effort", "mass_matrix"))):
            runner, none = warned(lambda each=each, params=params: make(each, params=params))
            runner.close()
            assert none == []


def test_candidates_of_a_search_do_not_warn(arm):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.simplefilter("error", StabilityWarning)
        tune(arm, generations=1, population=6, seconds=0.1, workers=0)


def light_joint(folder, inertia, effort, damping):
    body = f'<inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="{inertia}" iyz="0" izz="1"/></inertial>'
    inner = f'<limit lower="-3" upper="3" effort="{effort}" velocity="9"/><dynamics damping="{damping}"/>'
    return Robot.load(write(folder, one_joint(inner, arm=body)))


def sticks(inertia, effort, damping, kp, kd, timestep):
    """Return whether the force of MuJoCo's own servo still alternates between its limits after a second."""
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option integrator="implicitfast" gravity="0 0 0" timestep="{timestep}"/><worldbody><body>
        <inertial pos="0 0 0" mass="1" diaginertia="1 {inertia} 1"/><joint name="j" axis="0 1 0" damping="{damping}"/>
        </body></worldbody><actuator><position joint="j" kp="{kp}" kv="{kd + timestep * kp}"
        forcerange="-{effort} {effort}"/></actuator></mujoco>"""
    )
    data, forces = mujoco.MjData(model), []
    data.ctrl[0] = 0.3
    for _ in range(round(1 / timestep)):
        mujoco.mj_step(model, data)
        forces.append(data.actuator_force[0])
    last = np.array(forces[-60:])
    return bool((last[1:] * last[:-1] < -0.99 * effort**2).all())


DRIVEN = {"engine": "mujoco", "control": "drive", "compensate": "none", "ground": False}


@pytest.mark.parametrize("seed", range(16))
def test_a_drive_that_sticks_in_mujoco_is_named(tmp_path, seed):
    """A force at its limit is not implicit: the joint alternates where kd dt > 2 I, and does not below."""
    pytest.importorskip("mujoco.batch")
    rng = np.random.default_rng(seed)
    inertia, timestep, ratio = 10 ** rng.uniform(-4, -2), rng.choice([5e-4, 2e-3]), [0.6, 20.0][seed % 2]
    kd = ratio * 2 * inertia / timestep
    kp, damping = 10 * kd, 0.2 * inertia / timestep
    effort = kp * rng.uniform(0.02, 0.1)
    arm = light_joint(tmp_path, inertia, effort, damping)
    substeps = int(rng.choice([1, 7, 20]))

    def move():
        options = {"params": arm.params(kp=kp, ki=0, kd=kd), "timestep": timestep, "substeps": substeps}
        with make(arm, **DRIVEN, **options) as runner:
            runner.reset([0])
            runner.rollout(np.full((round(1 / timestep / substeps), 1), 0.3))

    _, messages = warned(move)
    assert sticks(inertia, effort, damping, kp, kd, timestep) == (ratio > 1)
    assert len(messages) == (ratio > 1)
    assert all("env 0, joint 'hinge': its drive alternates between its effort limits" in each for each in messages)


def test_the_env_that_sticks_is_named_once_and_lower_gains_help(tmp_path):
    pytest.importorskip("mujoco.batch")
    arm = light_joint(tmp_path, 1e-3, 20, 2)
    kd = np.array([[0.5], [100]])
    with make(arm, 2, params=arm.params(kp=10 * kd, ki=0, kd=kd), **DRIVEN) as runner:

        def move():
            runner.reset([0])
            for _ in range(30):
                runner.step([0.2])

        _, (message,) = warned(move)
        assert "env 1, joint 'hinge'" in message
        assert "engine='sapien'" in message
        assert warned(move)[1] == []
    with make(arm, 1, params=arm.params(kp=5, ki=0, kd=0.5), **DRIVEN) as runner:
        assert warned(lambda: runner.rollout(np.full((100, 1), 0.2)))[1] == []


@pytest.mark.parametrize("engine", ["sapien", "mujoco"])
def test_drives_of_bundled_robots_do_not_warn(panda, jaco2, engine):
    pytest.importorskip("mujoco.batch")
    for each in (panda, jaco2):
        with make(each, **DRIVEN | {"engine": engine}) as runner:
            goal = np.clip(each.start + 1.0, each.lower, each.upper)
            assert warned(lambda runner=runner, goal=goal: runner.rollout(np.tile(goal, (30, 1))))[1] == []
