"""State of one runner is refused in another, or gives the same result there: for every option."""

from dataclasses import fields

import numpy as np
import pytest

import batchpid as bp
from batchpid.errors import InvalidArgumentError
from batchpid.sim import OperationalSpace, Randomization, Robot, Runner, RunnerOptions, Uniform
from batchpid.sim.gym import ReachVectorEnv, ToolReachVectorEnv

pytest.importorskip("mujoco")
POSTURE = np.array([0, -0.5, 0, -2.2, 0, 1.8, 0.8, 0.02, 0.02])
OTHER = {
    "stiffness": {"stiffness": 1000.0},
    "damping": {"damping_ratio": 0.1},
    "link": {"link": "panda_link5"},
    "point": {"point": [0, 0, 0.3]},
    "posture": {"posture": POSTURE + 0.01},
}
CHOSEN_ANEW = {
    "workers", "cluster", "timeout", "recover", "checkpoint_steps", "pack_size", "substeps", "on_fault",
    "on_invalid_input", "speed_limit",
}  # fmt: skip
"""Options of how a run goes on, not of the state."""
CARRIED = {"robot", "actuators", "build"}
"""Parts that are in the snapshot itself, or in the sizes of its arrays."""


def osc_runner(robot, link="panda_hand", **options):
    control = OperationalSpace(robot, link, **{"posture": POSTURE, **options})
    return Runner(robot, 1, workers=0, engine="mujoco", control=control)


@pytest.fixture(scope="module")
def panda():
    return Robot.load("panda")


def test_every_option_is_in_the_snapshot_or_has_a_reason_not_to_be():
    marked = {each.name for each in fields(RunnerOptions) if "snapshot" in each.metadata}
    assert {each.name for each in fields(RunnerOptions)} == marked | CHOSEN_ANEW | CARRIED
    assert not marked & (CHOSEN_ANEW | CARRIED)


@pytest.mark.parametrize("other", OTHER.values(), ids=OTHER)
def test_a_snapshot_of_another_controller_is_refused(panda, other):
    with osc_runner(panda) as runner:
        runner.reset(POSTURE)
        snapshot = runner.snapshot()
        runner.restore(snapshot)
    with osc_runner(panda, **other) as runner, pytest.raises(InvalidArgumentError, match=r"controller|tool"):
        runner.restore(snapshot)


def test_a_snapshot_fits_an_equal_controller(panda):
    with osc_runner(panda) as runner:
        snapshot = runner.snapshot()
    with osc_runner(panda) as runner:
        runner.restore(snapshot)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("task", [ReachVectorEnv, ToolReachVectorEnv])
@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_a_drawn_start_is_the_first_setpoint(task, mode):
    def place(env):
        return env.observed.qpos if task is ReachVectorEnv else env.observed.tool_pose[:, :3]

    drawn = Randomization(qpos=Uniform(-0.2, 0.2))
    env = task(2, workers=0, actions="increment", engine="mujoco", randomization=drawn, max_episode_steps=3,
               autoreset_mode=mode)  # fmt: skip
    with env.runner:
        env.reset(seed=1)
        start = None
        for _ in range(8):
            seen = place(env)
            if start is None:
                start = seen
            *_, truncated, _ = env.step(np.zeros(env.action_space.shape, np.float32))
            if truncated.any() or not env._steps.any():
                start = None
            else:
                assert np.abs(place(env) - start).max() < 0.02


GIVEN = {"gain_units": ["inertia", "mass_matrix"], "measurement_rate": ["measured"]}


@pytest.mark.parametrize(("name", "value"), [(name, value) for name, values in GIVEN.items() for value in values])
def test_the_pure_law_refuses_what_it_is_not_given(name, value):
    params = bp.make_params(2, 4.0, 1.0, 1.0, **{name: value})
    y = np.zeros((1, 2))
    state = bp.init(params, y)

    def call():
        return bp.BatchPID(params, 1, 0.01)(y, y)

    calls = [lambda f=f: f(params, state, y, y, 0.01) for f in (bp.step, bp.step_terms, bp.drive_target)]
    for each in (*calls, lambda: bp.track(params, state, y, y, y, dt=0.01), call):
        with pytest.raises(InvalidArgumentError, match=name):
            each()


@pytest.mark.parametrize("rate", [2000, 50])
def test_a_rate_is_no_time_step(rate):
    with pytest.raises(InvalidArgumentError, match=f"1/{rate}"):
        bp.BatchPID(bp.make_params(1, 1.0), 1, rate)
