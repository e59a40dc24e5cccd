"""Each effect of the actuators against its closed form, and against independent statements of its
peers' formulas.
"""

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from law_cases import read_only
from quick_jit import quick_jit

import batchpid as bp
from batchpid import motors as actuators
from batchpid.motors import sensor_noise as noise

DT = 1 / 2000
positive = st.floats(1e-3, 1e3)


def run_motor(chosen, efforts, qpos=0.0, qvel=0.0, before=0.0):
    """Return the efforts (steps, 1, joints) that are delivered for ``efforts`` (steps, joints)."""
    rows = np.asarray(efforts, float).reshape(len(efforts), 1, -1)
    at, speed = np.zeros_like(rows[0]) + qpos, np.zeros_like(rows[0]) + qvel
    state = actuators.init(chosen, at, DT, qvel=speed, effort=np.zeros_like(rows[0]) + before)
    k, delivered = actuators.discretise(chosen, state, DT), []
    for row in rows:
        state, effort = actuators.advance_effort(k, state, read_only(row, float), speed)
        delivered.append(effort)
    return np.array(delivered)


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=50)
def test_the_command_limits_are_where_the_motor_clips(seed):
    """Clipped to them a command has the same effect, and within them it has all of its effect,
    without delay or lag.
    """
    rng, joints = np.random.default_rng(seed), 30
    strength = np.where(rng.random(joints) < 0.2, 0.0, rng.uniform(0.2, 3, joints))
    options = {"strength": strength, "bias": rng.normal(0, 5, joints)}
    options = {name: options[name] for name in options if rng.random() < 0.7}
    line = {
        "saturation_effort": rng.uniform(1, 40, joints),
        "no_load_speed": rng.uniform(1, 5, joints),
    }
    shape = {"effort_limit": rng.uniform(1, 30, joints)}
    static = bp.make_actuators(joints, **options, **(line if rng.random() < 0.5 else {}), **shape)
    late = static.replace(command_delay=0.01, lag=0.1)
    asked, q, v = (
        rng.normal(0, 100, (1, joints)),
        rng.normal(0, 2, (1, joints)),
        rng.normal(0, 3, (1, joints)),
    )
    ends = [
        actuators.command_limits(actuators.discretise(each, actuators.init(each, q, DT), DT), v)
        for each in (static, late)
    ]
    np.testing.assert_array_equal(*ends, "they have no dynamics")
    least, most = ends[0]
    assert (least <= most).all()
    clipped = np.clip(asked, least, most)
    delivered = run_motor(static, asked, q, v)
    # (limit - bias) / strength rounds, and a line from 40 N m on at 5 rad/s amplifies it.
    np.testing.assert_allclose(run_motor(static, clipped, q, v), delivered, rtol=1e-10, atol=1e-10)
    works = static.strength[0] > 0 if static.strength is not None else np.ones(joints, bool)
    free = clipped * options.get("strength", 1.0) + options.get("bias", 0.0)
    np.testing.assert_allclose(delivered[0, 0, works], free[0, works], rtol=1e-10, atol=1e-10)


def test_noise_has_the_moments_of_a_normal_distribution():
    key = noise.keys(np.array([[1, 2]], np.uint32), np.arange(50), np.zeros(50), np)
    both = noise.normals(
        key, np.arange(1000, dtype=np.uint32)[:, None] + np.zeros(50, np.uint32), 7, np.float64, np
    )
    count = both[0].size
    for z in both:
        assert abs(z.mean()) < 4 / np.sqrt(count)
        assert z.var() == pytest.approx(1, abs=4 * np.sqrt(2 / count))
        assert (z**4).mean() == pytest.approx(3, abs=4 * np.sqrt(96 / count))
        for shifted in (np.roll(z, 1, axis) for axis in range(3)):  # steps, envs and joints
            assert abs((z * shifted).mean()) < 4 / np.sqrt(count)
    assert abs((both[0] * both[1]).mean()) < 4 / np.sqrt(count)


def test_noise_depends_on_seed_env_episode_and_step_alone():
    q = np.zeros((4, 3))
    chosen = bp.make_actuators(3, position_noise=0.1, velocity_noise=0.2, seed=5)

    def measure(envs, episode=0, chosen=chosen):
        state, rows = (
            actuators.init(chosen, q[: len(envs)], DT, envs=np.array(envs), episode=episode),
            [],
        )
        k = actuators.discretise(chosen, state, DT)
        for _ in range(5):
            state, *seen = actuators.advance_measurement(k, state, *[q[: len(envs)]] * 2)
            rows.append(seen)
        return np.array(rows)

    all_four = measure([0, 1, 2, 3])
    np.testing.assert_array_equal(measure([2]), all_four[:, :, 2:3])
    assert len(np.unique(all_four)) > 0.98 * all_four.size
    others = (
        measure([2], episode=1),
        *(measure([2], chosen=chosen.replace(seed=seed)) for seed in (6, 5 + 2**32)),
    )
    for other in others:
        assert np.isin(other, all_four).mean() < 0.1
    np.testing.assert_allclose(all_four.std((0, 2, 3)), [0.1, 0.2], rtol=0.3)


def test_noise_is_the_same_in_jax_for_one_robot_at_a_time():
    chosen = bp.make_actuators(3, position_noise=0.1, velocity_noise=0.2, seed=5, dtype=np.float32)

    def measure(env, q):
        state, rows = actuators.init(chosen, q, DT, envs=env), []
        k = actuators.discretise(chosen.for_rank(q.ndim), state, DT)
        for _ in range(3):
            state, *seen = actuators.advance_measurement(k, state, q, q)
            rows.append(seen)
        return rows

    envs, q = np.arange(4), np.zeros((4, 3), np.float32)
    expected, found = measure(envs, q), quick_jit(jax.vmap(measure))(envs, q)
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    assert np.ptp(found) > 0.2
