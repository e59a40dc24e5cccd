"""The robot as MJCF: MuJoCo's own loader gives the simulated robot, with motors or servos."""

import mujoco
import numpy as np
import pytest
from export_cases import JOINTS, random_params, values
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_urdf import INERTIAL, joint, link, robot, write

import batchpid as bp
from batchpid.errors import InvalidArgumentError
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


@pytest.mark.parametrize("servos", [True, False], ids=["servos", "motors"])
def test_the_file_moves_as_the_runner_does(servos):
    """The servos are the law, and motors deliver the efforts of a law outside of MuJoCo."""
    loaded = Robot.load("panda", actuators=bp.make_actuators(9, armature=0.05))
    params = bp.make_params(
        9, 40.0, 0.0, 2.0, effort_limit=loaded.effort_limit / 10, measurement_rate="measured"
    )
    exported = to_mjcf(loaded, params if servos else None, DT)
    assert exported.differences == ()
    model = model_of(exported)
    data, goal = mujoco.MjData(model), 0.5 * (loaded.start + loaded.settings.target)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    np.testing.assert_array_equal(data.ctrl, servos * loaded.start)
    state, options = bp.init(params, data.qpos[None]), {"workers": 0, "engine": "mujoco"}
    options |= {"timestep": DT, "substeps": 1, "compensate": "none", "params": params}
    with Runner(loaded, 1, **options) as runner:
        runner.reset()
        for _ in range(200):
            seen = runner.step(goal)
            state, effort = bp.step(
                params, state, goal[None], data.qpos[None], DT, measurement_rate=data.qvel[None]
            )
            data.ctrl[:] = goal if servos else effort[0]
            mujoco.mj_step(model, data)
            np.testing.assert_allclose(data.qpos, seen.qpos[0], rtol=0, atol=1e-6)
    assert np.abs(seen.qpos[0] - loaded.start).max() > 0.05
    assert seen.saturated.any()


def test_an_inertia_of_no_body_is_replaced_and_listed(tmp_path):
    impossible = INERTIAL.replace('izz="0.1"', 'izz="0.3"')
    loaded = Robot.load(
        write(tmp_path, robot(link("x"), link("y", impossible), joint("a", "x", "y")))
    )
    exported = to_mjcf(loaded, plain(loaded), DT)
    said = exported.differences[-1]
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


LINKS = [link(name, INERTIAL) for name in "wxyz"]
ENDS = zip(JOINTS, ("wx", "xy", "yz"), strict=True)
CHAIN = robot(*LINKS, *(joint(name, *ends) for name, ends in ENDS))


@given(random_params(), st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_a_robot_read_from_its_file_has_the_same_gains_and_joints(tmp_path_factory, params, seed):
    params = params.replace(kp=params.kp + 1.0)  # a file without any stiffness has no servos
    folder, inertia = tmp_path_factory.mktemp("chain"), np.array([2.0, 1.0, 0.5])
    rng = np.random.default_rng(seed)
    motors = {name: rng.uniform(0.01, 1, 3) for name in ("armature", "coulomb", "viscous")}
    chain = Robot.load(write(folder, CHAIN), actuators=bp.make_actuators(3, **motors))
    assert list(chain.joint_names) == JOINTS
    (path := folder / "chain.xml").write_text(to_mjcf(chain, params, DT, inertia=inertia).text)
    other = Robot.load(path)
    scale = 1.0 if params.gain_units is None else inertia
    tolerance = 1e-12 if params.dtype == np.float64 else 1e-6
    for name in ("kp", "kd"):
        np.testing.assert_allclose(
            values(other.mjcf_gains(), name), np.array(values(params, name)) * scale, rtol=tolerance
        )
    for name, found in (
        ("armature", other.actuators.armature[0]),
        ("coulomb", other.friction),
        ("viscous", other.damping),
    ):
        np.testing.assert_allclose(found, motors[name], rtol=1e-12)


def test_a_floating_base_starts_as_in_the_runner():
    robot = Robot.load("quadruped", fixed_base=False)
    text = to_mjcf(robot, None, 1e-3).text
    model = mujoco.MjModel.from_xml_string(text)
    with Runner(robot, 1, workers=0, engine="mujoco") as runner:
        np.testing.assert_allclose(model.key_qpos[0, :7], runner.observe().base_pose[0], atol=1e-6)
