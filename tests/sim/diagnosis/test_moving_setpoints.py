"""Trajectories under the default gains: robots follow them with rates."""

import numpy as np
import pytest
from robots import load_bundled

from batchpid.sim import Runner
from batchpid.trajectories import minimum_jerk

N, DT = 2, 0.01


def moves(robot, count=N, seed=0):
    """Return starts (count, dof) and smooth moves from there at half the velocity limits."""
    low, high = np.maximum(robot.lower, -2.5), np.minimum(robot.upper, 2.5)
    share = np.random.default_rng(seed).uniform(0.4, 0.6, (2, count, robot.dof))
    start, target = robot.coupling.positions(low + share * (high - low))
    limit = 0.5 * robot.velocity_limit
    return start, minimum_jerk(start, target, DT, max_velocity=limit, hold=0.2)


def follow(robot, start, move, *, rates=True, accelerations=False, **options):
    given = {"setpoint_rates": move.velocity} if rates else {}
    given |= {"setpoint_accelerations": move.acceleration} if accelerations else {}
    with Runner(robot, len(start), workers=0, **{"collisions": False} | options) as runner:
        runner.reset(start)
        return runner.rollout(move.position, **given)


@pytest.mark.quick_rows(4)
@pytest.mark.parametrize("engine", ["sapien", "mujoco"])
@pytest.mark.parametrize("name", ["panda", "jaco2"])
@pytest.mark.parametrize("gains", ["tuned", "designed"])
def test_default_gains_follow_a_trajectory(name, engine, gains):
    robot = load_bundled(name)
    start, move = moves(robot)
    options = {"engine": engine, "params": robot.designed() if gains == "designed" else None}
    error = {}
    for kind, given in {
        "steps": {"rates": False},
        "rates": {},
        "accelerations": {"accelerations": True},
    }.items():
        seen = follow(robot, start, move, **given, **options)
        off = seen.qpos - move.position
        error[kind] = np.abs(off).max()
        way = move.position[-1] - start
        over = (off[-20:] * np.sign(way)).max(0)[np.abs(way) > 0.05] / np.abs(
            way[np.abs(way) > 0.05]
        )
        assert kind == "steps" or over.max() < 0.01
    assert error["steps"] > 0.1
    assert error["rates"] < 0.002
    assert error["accelerations"] < 0.002


@pytest.mark.quick_rows(5)
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"control": "drive", "params": "effort"},
        {"guard": True},
        {"params": "implicit"},
        {"params": "effort"},
    ],
    ids=str,
)
@pytest.mark.parametrize("engine", ["sapien", "mujoco"])
def test_every_control_carries_the_setpoint_on(options, engine):
    panda = load_bundled("panda")
    start, move = moves(panda, seed=1)
    params = {
        None: None,
        "implicit": (
            panda.designed().replace(discretization="implicit", derivative_filter_time=None)
        ),
        "effort": panda.params(kp=300.0, ki=50.0, kd=30.0),
    }[options.get("params")]
    options = {**options, "params": params, "engine": engine}
    ours = follow(panda, start, move, **options)
    lagging = follow(panda, start, move, rates=False, **options)
    assert (
        np.abs(ours.qpos - move.position).max() < 0.6 * np.abs(lagging.qpos - move.position).max()
    )


def test_the_rates_of_increments_have_no_acceleration():
    """A policy's rates jump from tick to tick; those of a trajectory are continuous."""
    panda = load_bundled("panda")
    rng = np.random.default_rng(0)
    start = np.tile(panda.settings.target, (N, 1))
    position = start + np.cumsum(
        rng.uniform(-0.01, 0.01, (20, N, panda.dof)) * (np.arange(9) < 7), axis=0
    )
    rate = np.diff(position, axis=0, prepend=start[None]) / DT
    runs = []
    for acceleration in (None, 0 * rate, 1 + 0 * rate):
        with Runner(panda, N, workers=0, collisions=False) as runner:
            runner.reset(start)
            runs.append(
                runner.rollout(position, setpoint_rates=rate, setpoint_accelerations=acceleration)
            )
    np.testing.assert_array_equal(runs[0].qpos, runs[1].qpos)
    assert np.abs(runs[2].qpos - runs[0].qpos).max() > 1e-3
