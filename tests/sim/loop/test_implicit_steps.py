"""The implicit law on real robots at large time steps: stable, and as exact as at small ones."""

import warnings

import numpy as np
import pytest
from robots import load_bundled, load_published
from tiny_urdf import random_tree, robot, write

from batchpid.sim import Robot, Runner, StabilityWarning
from batchpid.trajectories import minimum_jerk

PUBLISHED = [
    f"{name}_description/urdf/{file}.urdf"
    for name, file in (("ur", "ur5_robot"), ("xarm", "xarm7"), ("z1", "z1"))
]
DURATION, HELD = 1.0, 0.3


@pytest.fixture(
    scope="module",
    params=[
        "panda",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("jaco2", "tree", *PUBLISHED)),
    ],
)
def arm(request, tmp_path_factory):
    if request.param != "tree":
        return load_published(request.param)
    path = write(tmp_path_factory.mktemp("tree"), robot(*random_tree(np.random.default_rng(5), 12)))
    return Robot.load(path, self_collision="none")


def params_of(arm, w, discretization="implicit", **options):
    options = {"ki": None, "effort_limit": None, "measurement_rate": "measured", **options}
    units = {"gain_units": "mass_matrix", "discretization": discretization}
    return arm.params(kp=w**2, kd=2 * w, **units, **options)


def move_of(arm, dt):
    """Return a start, and a motion of up to 0.8 rad or m of every joint within its limits."""
    low, high = np.maximum(arm.lower, -2.0), np.minimum(arm.upper, 2.0)
    start = arm.coupling.positions(arm.start)
    way = np.where(high - start > start - low, 0.8, -0.8)
    margin = 0.02 * (high - low)
    goal = arm.coupling.positions(np.clip(start + way, low + margin, high - margin))
    return start, minimum_jerk(start, goal, dt, duration=DURATION, hold=HELD)


def largest_error(arm, dt, params, engine="sapien", substeps=1):
    """Return the largest error during the motion, and afterwards [rad or m]."""
    start, move = move_of(arm, dt * substeps)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with Runner(
            arm, 1, params=params, workers=0, timestep=dt, substeps=substeps, engine=engine
        ) as runner:
            runner.reset(start)
            rollout = runner.rollout(move.position[:, None], setpoint_rates=move.velocity[:, None])
    error = np.nan_to_num(np.abs(rollout.qpos - rollout.setpoint)[:, 0], nan=1e9)
    return error.max(), error[-1].max()


@pytest.mark.slow
@pytest.mark.parametrize("w", [100.0, 316.0])
def test_it_is_stable_at_large_time_steps_and_tracks_as_at_small_ones(arm, w):
    (fine, _), *coarse = (
        largest_error(arm, dt, params_of(arm, w)) for dt in (1 / 2000, 1 / 500, 1 / 100)
    )
    assert fine < 7 / w**2
    assert coarse[0][0] < 1.05 * fine  # at 1/500
    assert coarse[1][0] < 0.15e-3  # at 1/100
    assert max(after for _, after in coarse) < 1e-5
    assert largest_error(arm, 1 / 100, params_of(arm, w, "explicit"))[0] > 1.0  # w dt > 0.828


def test_its_integral_tracks_too(arm):
    w = 200.0
    params = params_of(arm, w, ki=w**3 / 5.2)
    for dt in (1 / 500, 1 / 100):
        worst, after = largest_error(arm, dt, params)
        assert worst < 0.5e-3
        assert after < 1e-4


def test_setpoint_steps_in_long_ticks_settle():
    """The mass matrix is fresh in every sim step: kept for 4 steps, it would diverge."""
    panda = load_bundled("panda")
    target = panda.settings.target
    with Runner(
        panda, 1, params=params_of(panda, 100.0), workers=0, timestep=1 / 100, substeps=20
    ) as runner:
        runner.reset(panda.start)
        rollout = runner.rollout(np.broadcast_to(target, (3, panda.dof)))
    np.testing.assert_allclose(rollout.qpos[-1, 0], target, atol=1e-4)


def test_no_gain_passes_the_stability_bound(panda):
    params = params_of(panda, 1e4)
    with warnings.catch_warnings():
        warnings.simplefilter("error", StabilityWarning)
        Runner(panda, 1, params=params, workers=0, timestep=1 / 100, collisions=False).close()
    (found,) = [one for one in panda.check(params=params) if one.code == "unstable"]
    assert "1.52 times" in str(found)  # w dt = 5
    assert not [one for one in panda.check(params=params_of(panda, 30.0)) if one.code == "unstable"]
