"""The robot as MJCF: MuJoCo's own loader gives the simulated robot, and its actuators the law."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from export_cases import JOINTS, random_params, values
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_urdf import INERTIAL, joint, link, robot, write

import batchpid as bp
from batchpid.errors import InvalidArgumentError
from batchpid.motors import actuator_dynamics as motor_model
from batchpid.motors import guard as guard_model
from batchpid.sim import Robot, Runner
from batchpid.sim.robot.mjcf_export import to_mjcf

DT = 1 / 2000


def model_of(exported):
    return mujoco.MjModel.from_xml_string(exported.text)


def plain(loaded, **options):
    return bp.make_params(loaded.dof, 40.0, 5.0, 2.0, measurement_rate="measured", **options)


@pytest.mark.parametrize("name", Robot.bundled())
def test_the_loaded_model_has_the_dynamics_of_the_robot(name):
    loaded = Robot.load(name)
    model = model_of(to_mjcf(loaded, plain(loaded), DT))
    oracle = loaded.dynamics()
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    columns = [model.joint(each).dofadr[0] for each in loaded.joint_names]
    for qpos in loaded.sample(3):
        data.qpos[columns], data.qvel[columns] = qpos, (qvel := rng.normal(size=loaded.dof))
        mujoco.mj_forward(model, data)
        matrix = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, matrix)
        np.testing.assert_allclose(
            matrix[np.ix_(columns, columns)],
            oracle.mass_matrix(qpos[None])[0],
            rtol=1e-10,
            atol=1e-12,
        )
        bias = oracle.inverse_dynamics(qpos[None], qvel[None], 0 * qpos[None])[0]
        np.testing.assert_allclose(data.qfrc_bias[columns], bias, rtol=1e-9, atol=1e-10)
    for each in loaded.joints:
        held = model.joint(each.name)
        assert (held.damping[0], held.frictionloss[0]) == (each.damping, each.friction)
        assert bool(held.limited[0]) == (
            not each.continuous and np.isfinite([each.lower, each.upper]).any()
        )
        if held.limited[0]:
            np.testing.assert_allclose(
                held.range, np.clip([each.lower, each.upper], -1e10, 1e10), rtol=1e-12
            )


@pytest.mark.parametrize("effects", [{}, {"saturation_effort": 60.0, "no_load_speed": 9.0}])
def test_the_file_moves_as_the_runner_does(effects):
    loaded = Robot.load("panda")
    params = plain(loaded, **({} if effects else {"effort_limit": loaded.effort_limit}))
    motors = bp.make_actuators(9, **effects)
    exported = to_mjcf(loaded, params, DT, actuators=motors)
    assert exported.differences == ()
    model = model_of(exported)
    data, goal = mujoco.MjData(model), 0.5 * (loaded.start + loaded.settings.target)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    options = {
        "workers": 0,
        "timestep": DT,
        "substeps": 1,
        "engine": "mujoco",
        "compensate": "gravity+coriolis",
    }
    with Runner(loaded, 1, params=params, actuators=motors, **options) as runner:
        runner.reset()
        for _ in range(200):
            reached = runner.step(goal).qpos[0]
            mujoco.mj_forward(model, data)
            data.ctrl[:] = np.stack([goal, 0 * goal, data.qfrc_bias], axis=1).ravel()
            mujoco.mj_step(model, data)
            np.testing.assert_allclose(data.qpos, reached, rtol=0, atol=1e-6)
    assert np.abs(reached - loaded.start).max() > 0.1


def test_an_inertia_of_no_body_is_replaced_and_listed(tmp_path):
    impossible = INERTIAL.replace('izz="0.1"', 'izz="0.3"')
    loaded = Robot.load(
        write(tmp_path, robot(link("x"), link("y", impossible), joint("a", "x", "y")))
    )
    exported = to_mjcf(loaded, plain(loaded), DT)
    (said,) = exported.differences
    assert said.startswith("inertia: the nearest possible tensor instead")
    moments = np.sort(model_of(exported).body("y").inertia)
    assert moments[0] + moments[1] >= moments[2] * (1 - 1e-9)


def test_bad_requests_are_refused():
    loaded = Robot.load("panda")
    for params in (
        plain(loaded).replace(gain_units="mass_matrix"),
        plain(loaded, effort_min=1.0, effort_max=1.0),
    ):
        with pytest.raises(InvalidArgumentError):
            to_mjcf(loaded, params, DT)


STRONG = {"strength": np.linspace(0.8, 1.1, 9), "armature": 0.05, "coulomb": 0.1}
LATE = STRONG | {"bias": np.linspace(-0.5, 0.5, 9), "command_delay": np.linspace(0, 0.0041, 9)}
ALONE = {
    "limit": LATE | {"effort_limit": 3.0},
    "lag": LATE | {"lag": 0.003},
    "line": STRONG | {"saturation_effort": np.linspace(4, 9, 9), "no_load_speed": 2.0},
}


@pytest.mark.parametrize("name", ALONE)
def test_the_motors_alone_deliver_what_the_actuators_do(name):
    loaded, motors = Robot.load("panda"), bp.make_actuators(9, **ALONE[name])
    exported = to_mjcf(loaded, None, DT, actuators=motors)
    assert [each.partition(":")[0] for each in exported.differences] == ["friction"]
    model = model_of(exported)
    assert (model.nu, model.na) == (9, 9 if name == "lag" else 0)
    data, state, limited = mujoco.MjData(model), motor_model.init(motors, np.zeros((1, 9)), DT), 0
    for step in range(240):
        command, v = 9 * np.sin(0.05 * step + np.arange(9)), data.qvel[None].copy()
        state, effort = motor_model.deliver(
            motors, state, command[None], data.qpos[None].copy(), v, DT
        )
        data.ctrl[:] = command
        mujoco.mj_step(model, data)
        if step > 150:  # before, delays and lags remember other efforts
            np.testing.assert_allclose(data.qfrc_actuator, effort[0], rtol=0, atol=1e-9)
        limited += (np.abs(effort[0]) < 0.7 * np.abs(command)).sum()
    assert limited > 100


LINE = {"saturation_effort": 6.0, "no_load_speed": 1.5}
EFFECTS = {"pid": {}, "line": LINE, "both": LINE | {"lag": 0.004}, "lag": {"lag": 0.004}}


def arm_motion(step, joints=9):
    """Return inputs that move the arm, saturate its motors and wind its integral."""
    phase = np.arange(joints)
    wanted, rate = (
        0.5 * np.sign(np.sin(0.02 * step + phase)) + 0.4 * np.sin(0.05 * step),
        np.cos(0.03 * step + phase),
    )
    return wanted, rate, 0.5 * np.sin(0.02 * step) * np.ones(joints)


@pytest.mark.parametrize(
    ("guarded", "effects"),
    [
        pytest.param(
            guarded, EFFECTS[name], id=f"{guarded}-{name}", marks=() if quick else pytest.mark.slow
        )
        for guarded, names in ((False, ("pid", "both")), (True, ("line", "lag")))
        for name, quick in ((each, each in names) for each in EFFECTS)
    ],
)
def test_the_actuators_compute_the_law_the_guard_and_the_motors(effects, guarded):
    """The guard, the law and the motors of batchpid, step by step, are MuJoCo's actuators.

    A lag beside a line is listed: MuJoCo's does not end at the line.
    """
    loaded = Robot.load("panda")
    params = plain(loaded).replace(kp=np.linspace(5, 80, 9), ki=np.linspace(1, 30, 9))
    limits = {"integral_limit": np.linspace(0.02, 0.5, 9)} if effects else {}
    params = params.replace(**(limits or {"effort_min": -3.0, "effort_max": 4.0}))
    motors = bp.make_actuators(9, **effects) if effects else None
    ends = {"lower": loaded.lower, "upper": loaded.upper} if not effects else {}
    guard = bp.make_guard(9, rate=np.linspace(0.4, 1.2, 9), **ends) if guarded else None
    exported = to_mjcf(loaded, params, DT, actuators=motors, guard=guard)
    listed = [*(["lag"] if len(effects) == 3 else []), *(["guard"] if guarded else [])]
    assert [each.partition(":")[0] for each in exported.differences] == listed
    model = model_of(exported)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    np.testing.assert_array_equal(data.qpos, loaded.start)
    state = bp.init(params, data.qpos[None])
    motor = None if motors is None else motor_model.init(motors, data.qpos[None], DT)
    guard_state = None if guard is None else guard_model.init(guard, data.qpos[None])
    clipped, late = 0, np.zeros((1, 9))
    for step in range(400):
        wanted, rate, feedforward = arm_motion(step)
        data.ctrl[:] = np.stack([wanted, rate, feedforward], axis=1).ravel()
        q, v, setpoint = data.qpos[None].copy(), data.qvel[None].copy(), wanted[None]
        if guard is not None:
            guard_state, _ = guard_model.advance(guard, guard_state, setpoint, DT)
            setpoint = guard_state.setpoint
        rates = {
            "measurement_rate": v,
            "setpoint_rate": rate[None],
            "feedforward": feedforward[None],
        }
        state, asked = bp.step(params, state, setpoint, q, DT, **rates)
        effort = asked
        if motors is not None:
            motor, effort = motor_model.deliver(motors, motor, asked, q, v, DT)
        if len(effects) == 3:
            line = np.clip(asked, *(6.0 * (end - v / 1.5) for end in (-1, 1)))
            late += (1 - np.exp(-DT / 0.004)) * (line - late)
            effort = late
        mujoco.mj_step(model, data)
        np.testing.assert_allclose(data.qfrc_actuator, effort[0], rtol=0, atol=1e-9)
        clipped += (np.abs(effort - asked) > 1e-6).sum()
    assert bool(clipped) == bool(effects)


def test_limits_of_the_effort_act_beside_a_line():
    """One-sided limits are the joint's own; where the law's are narrower than the motor's,
    overspeed is listed.
    """
    loaded = Robot.load("panda")
    motors = bp.make_actuators(9, effort_limit=4.0, **LINE)
    even = to_mjcf(loaded, plain(loaded, effort_limit=4.0), DT, actuators=motors)
    assert [each.partition(":")[0] for each in even.differences] == []
    assert model_of(even).jnt_actfrcrange.tolist() == [[-4.0, 4.0]] * 9
    params = plain(loaded, effort_min=-2.0, effort_max=3.0).replace(ki=0.0)
    exported = to_mjcf(loaded, params, DT, actuators=motors)
    (said,) = exported.differences
    assert said.startswith("saturation_effort: beyond its line")
    model = model_of(exported)
    np.testing.assert_array_equal(model.jnt_actfrcrange, [[-2.0, 3.0]] * 9)


def test_a_guard_is_written_or_listed():
    loaded = Robot.load("panda")
    params = plain(loaded).replace(kd=0.0)
    guard = loaded.guard()
    exported = to_mjcf(loaded, params, DT, guard=guard)
    assert exported.differences == ()
    model = model_of(exported)
    positions = model.actuator_ctrlrange[::3]
    np.testing.assert_array_equal(positions, np.stack([guard.lower[0], guard.upper[0]], 1))
    np.testing.assert_array_equal(model.actuator_dynprm[:, 1], guard.rate[0])
    accelerated = guard._replace(acceleration=np.full((1, 9), 2.0))
    (said,) = to_mjcf(loaded, params, DT, guard=accelerated).differences
    assert said.startswith("guard: the acceleration of the setpoint is not limited")
    (said,) = to_mjcf(
        loaded, params, DT, guard=guard, actuators=bp.make_actuators(9, lag=0.01)
    ).differences
    assert said.startswith("guard: a dcmotor has no limits of the position alone")
    with pytest.raises(InvalidArgumentError, match="guard"):
        to_mjcf(loaded, None, DT, guard=guard)


LINKS = [link(name, INERTIAL) for name in "wxyz"]
ENDS = zip(JOINTS, ("wx", "xy", "yz"), strict=True)
CHAIN = robot(*LINKS, *(joint(name, *ends) for name, ends in ENDS))


EFFECTS = ("saturation_effort", "no_load_speed", "lag")


def symmetric_limit(params):
    """Return the limit of the integral (joints,) that holds in both directions, infinite for none."""
    low, high = params.integral_min, params.integral_max
    below = np.full(3, np.inf) if low is None else -np.asarray(low)[0]
    above = np.full(3, np.inf) if high is None else np.asarray(high)[0]
    return np.maximum(np.minimum(below, above), 0.0)


@given(random_params(), st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_a_robot_read_from_its_file_has_the_same_law_and_motors(tmp_path_factory, params, seed):
    params = params.replace(kp=params.kp + 1.0)  # a file without any stiffness has no servos
    folder, inertia = tmp_path_factory.mktemp("chain"), np.array([2.0, 1.0, 0.5])
    chain, rng = Robot.load(write(folder, CHAIN)), np.random.default_rng(seed)
    assert list(chain.joint_names) == JOINTS
    motors = bp.make_actuators(
        3,
        armature=rng.uniform(0.01, 1, 3),
        coulomb=rng.uniform(0, 1, 3),
        viscous=rng.uniform(0, 1, 3),
        **{name: rng.uniform(0.1, 9, 3) for name in EFFECTS if seed % 2},
    )
    guard = chain.guard(rate=rng.uniform(1, 2, 3))
    exported = to_mjcf(chain, params, DT, actuators=motors, guard=guard, inertia=inertia)
    (path := folder / "chain.xml").write_text(exported.text)
    other = Robot.load(path)
    scale = 1.0 if params.gain_units is None else inertia
    tolerance = 1e-12 if params.dtype == np.float64 else 1e-6
    gains, limit = other.mjcf_gains(), symmetric_limit(params) * scale
    integral = np.array(values(params, "ki")) * (limit > 0)
    for name, wanted in (
        ("kp", values(params, "kp")),
        ("ki", integral),
        ("kd", values(params, "kd")),
    ):
        np.testing.assert_allclose(values(gains, name), np.array(wanted) * scale, rtol=tolerance)
    limit = np.where(integral > 0, limit, np.inf)
    np.testing.assert_allclose(symmetric_limit(gains), limit, rtol=tolerance)
    np.testing.assert_allclose(other.guard().rate, guard.rate, rtol=1e-12)
    for name, found in (
        *((name, getattr(other.actuators, name)[0]) for name in EFFECTS if seed % 2),
        ("armature", other.actuators.armature[0]),
        ("coulomb", other.friction),
        ("viscous", other.damping),
    ):
        np.testing.assert_allclose(found, getattr(motors, name)[0], rtol=1e-12)


def test_a_floating_base_starts_as_in_the_runner():
    robot = Robot.load("quadruped", fixed_base=False)
    text = to_mjcf(robot, None, 1e-3).text
    # Other programs refuse a range of no width.
    assert "frcrange" not in text
    model = mujoco.MjModel.from_xml_string(text)
    with Runner(robot, 1, workers=0, engine="mujoco") as runner:
        np.testing.assert_allclose(model.key_qpos[0, :7], runner.observe().base_pose[0], atol=1e-6)
