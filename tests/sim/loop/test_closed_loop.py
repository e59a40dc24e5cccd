"""Closed loops as pure functions: the motions of a Runner in MuJoCo, and gradients."""

from dataclasses import replace

import numpy as np
import pytest
from featured import robot_with
from option_values import ARM
from option_values import MOTORS as WORN
from robots import load_bundled
from thermal import Thermal

import batchpid as bp
from batchpid.errors import InvalidArgumentError
from batchpid.sim import Randomization, Runner, Uniform, closed_loop

N, SUBSTEPS, TICKS = 2, 20, 100
MOTORS = {"command_delay": 3e-3, "lag": 2e-3, "sensor_delay": 1e-3, "strength": 0.9}
JOINTS = {"coulomb": 0.2, "viscous": 0.1, "armature": 0.02}
PANDA = load_bundled("panda")
CASES = {
    "pid": (PANDA, {}),
    "efforts, guard and a thermal limit": (
        PANDA,
        {"params": PANDA.designed("effort"), "guard": True, "stages": [Thermal(8.0, 0.05)]},
    ),
    "motors and sensors": (PANDA, {"actuators": bp.make_actuators(9, **MOTORS, **JOINTS)}),
    "osc": (PANDA, {"control": "osc"}),
    "coupled joints": (robot_with("sliding mimic"), {}),
    "own friction": (replace(ARM, actuators=WORN), {}),
}


def target_of(robot, options):
    if options.get("control") == "osc":
        return np.array([0.4, 0.1, 0.5, 1.0, 0, 0, 0])
    if not robot.independent.all():
        return robot.target  # a step to its limits of 9 rad ends in chaos
    # Beyond a limit, so that joints meet theirs.
    ends = robot.start + 1.1 * (np.where(np.isfinite(robot.upper), robot.upper, 1.0) - robot.start)
    return np.where(np.arange(robot.dof) % 2, ends, robot.start)


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("case", CASES)
def test_motions_are_those_of_a_runner_in_mujoco_without_contact(case):
    robot, options = CASES[case]
    target = target_of(robot, options)
    loop = closed_loop(robot, N, **options)
    # Fingers that rest at their limit of 0 m would meet it or not by rounding.
    start = robot.start + np.where(np.char.find(robot.joint_names, "finger") > 0, 0.01, 0.0)
    state = loop.init(start)
    options = {"engine": "mujoco", "collisions": False, "workers": 0, **options}
    with Runner(robot, N, **options) as runner:
        runner.reset(start)
        for _ in range(TICKS):
            state, seen = loop.step(state, target, substeps=SUBSTEPS)
            expected = runner.step(target)
            np.testing.assert_allclose(seen.qpos, expected.qpos, atol=1e-6)
    at_limits = (seen.qpos > robot.upper) | (seen.qpos < robot.lower)
    is_free = "osc" in case or "coupled" in case or not np.isfinite(robot.upper).all()
    assert at_limits.any() or is_free


@pytest.fixture
def x64(needs_jax):
    import jax

    jax.config.update("jax_enable_x64", True)
    yield jax
    jax.config.update("jax_enable_x64", False)


def test_in_jax_it_is_the_loop_of_numpy(x64):
    actuators = bp.make_actuators(2, **MOTORS, position_noise=1e-4, **JOINTS)
    loop = closed_loop(ARM, 3, actuators=actuators, guard=ARM.guard())
    mask = np.array([True, False, True])
    results = []
    for xp, step, reset in (
        (np, loop.step, loop.reset),
        (x64.numpy, x64.jit(loop.step, static_argnames="substeps"), x64.jit(loop.reset)),
    ):
        state = loop.init(xp.asarray(ARM.start))
        state, _ = step(state, xp.full(2, 0.7), substeps=30)
        state = reset(state, xp.asarray(ARM.start), xp.zeros(2), xp.asarray(mask))
        assert np.asarray(state.episode).tolist() == [1, 0, 1]
        state, seen = step(state, xp.full(2, 0.7), xp.full(2, 0.1), substeps=20)
        results.append([np.asarray(leaf) for leaf in x64.tree.leaves((state, seen))])
    for ours, theirs in zip(*results, strict=True):
        np.testing.assert_allclose(ours.astype(float), theirs.astype(float), atol=1e-9)


def test_its_program_is_written_into_a_file(x64):
    from jax import export

    loop = closed_loop(ARM, 2, actuators=bp.make_actuators(2, **MOTORS), guard=ARM.guard())
    start, tree = x64.tree.flatten(loop.init(x64.numpy.asarray(ARM.start)))

    @x64.jit
    def tick(leaves, goal):
        return x64.tree.leaves(loop.step(x64.tree.unflatten(tree, leaves), goal, substeps=2))

    goal = x64.numpy.full(2, 0.7)
    read = export.deserialize(export.export(tick)(start, goal).serialize())
    for ours, theirs in zip(read.call(start, goal), tick(start, goal), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_gradients_to_gains_motors_and_masses_are_differences(x64):
    actuators = bp.make_actuators(2, command_delay=2e-3, strength=0.9)
    loop = closed_loop(ARM, 2, params=ARM.params(kp=60.0, ki=5.0, kd=6.0), actuators=actuators)
    start = x64.numpy.asarray(ARM.start)

    def loss(scales):
        gain, strength, mass = scales
        bodies = loop.plant.bodies
        bodies = bodies._replace(mass=mass * bodies.mass, tensor=mass * bodies.tensor)
        changed = loop.changed(
            params=loop.control.params._replace(kp=gain * loop.control.params.kp),
            actuators=actuators._replace(strength=strength * actuators.strength),
            plant=replace(loop.plant, bodies=bodies),
        )
        _, seen = changed.step(changed.init(start), start + 0.3, substeps=60)
        return (seen.qpos - start - 0.3).var() + (seen.qvel**2).mean()

    value = x64.jit(loss)
    ones = x64.numpy.ones(3)
    gradient = np.asarray(x64.jit(x64.grad(loss))(ones))
    for at, h in enumerate([1e-5] * 3):
        ends = [float(value(ones.at[at].add(sign * h))) for sign in (1, -1)]
        assert gradient[at] == pytest.approx((ends[0] - ends[1]) / (2 * h), rel=1e-5)
    assert (np.abs(gradient) > 1e-6).all()


class Masses:
    """A plant of the user's: masses of 1 kg that nothing holds."""

    def init(self, qpos, qvel):
        return {"q": qpos, "v": qvel}

    def read(self, state):
        return state["q"], state["v"]

    def step(self, state, effort):
        rate = state["v"] + 5e-4 * effort
        return {"q": state["q"] + 5e-4 * rate, "v": rate}


def test_a_plant_of_the_users_own():
    options = {"params": ARM.params(kp=400.0, ki=None, kd=40.0), "compensate": "none"}
    loop = closed_loop(ARM, 2, plant=Masses(), **options)
    state, seen = loop.step(loop.init(np.zeros(2)), np.full(2, 0.1), substeps=2000)
    np.testing.assert_allclose(seen.qpos, 0.1, atol=1e-6)
    assert not any(rows.any() for rows in loop.reset(state, np.zeros(2)).plant.values())
    with pytest.raises(InvalidArgumentError, match=r"^mask: is int64"):
        loop.reset(state, np.zeros(2), mask=np.arange(2))


@pytest.mark.parametrize(
    ("options", "argument"),
    [
        ({"control": "drive"}, "control"),
        ({"randomization": Randomization(payload=Uniform(0, 1))}, "randomization"),
        ({"robot": robot_with("floating base")}, "robot"),
        ({"timestep": 2.0}, "timestep"),
        ({"timstep": 1e-3}, "timstep: is not an argument of closed_loop; did you mean 'timestep'"),
    ],
)
def test_what_only_a_runner_has_is_refused_by_name(options, argument):
    with pytest.raises(InvalidArgumentError, match=f"^{argument}"):
        closed_loop(**{"robot": ARM, "num_envs": N, **options})
