"""Noise of logs, and the wander that it causes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("scipy")
from batchpid.sim.identification.problem import spread, whiten
from batchpid.sim.identification.regression import DRAWS, NOISE_CUTOFF, split

DT = 5e-4


@given(st.integers(0, 1000), st.integers(1, 5), st.floats(0.01, 100.0))
def test_whitening_is_the_inverse_root_of_the_covariance(seed, columns, size):
    rng = np.random.default_rng(seed)
    wander = size * rng.normal(size=(30, 2, columns))
    residual, jacobian = rng.normal(size=(30, 2)), rng.normal(size=(30, 2, 4))
    stretches = [np.arange(2, 15), np.arange(15, 28)]
    white, columns_of, determinants = whiten(wander, stretches, residual, jacobian)
    for number, rows in enumerate(stretches):
        for joint in range(2):
            covariance = np.eye(len(rows)) + wander[rows, joint] @ wander[rows, joint].T
            values, vectors = np.linalg.eigh(covariance)
            root = vectors @ np.diag(values**-0.5) @ vectors.T
            np.testing.assert_allclose(white[rows, joint], root @ residual[rows, joint], atol=1e-9)
            np.testing.assert_allclose(columns_of[rows, joint], root @ jacobian[rows, joint], atol=1e-9)
            assert determinants[number, joint] == pytest.approx(0.5 * np.log(values).mean())
    for rows in (0, 1, 28, 29):  # in no stretch
        assert np.array_equal(white[rows], residual[rows])


def test_the_spread_of_draws_has_their_covariance():
    draws = np.random.default_rng(0).normal(size=(500, 6, 1)) @ np.ones((1, 2))
    columns = spread(draws)[:, 0]
    np.testing.assert_allclose(columns @ columns.T, np.cov(draws[:, :, 0].T), atol=1e-12)


@pytest.mark.slow
@settings(max_examples=12)
@given(st.floats(1e-6, 1e-3), st.integers(1, 2))
def test_the_noise_of_a_log_is_told_from_its_motion(size, every):
    rng, time = np.random.default_rng(0), DT * np.arange(4000)
    motion = np.stack([np.sin(6 * time), 0.2 * np.sin(20 * time)], axis=1)
    true = size * rng.standard_normal(motion.shape)
    slow, noise = split(time[::every], (motion + true)[::every], time)
    np.testing.assert_allclose(noise.size, size, rtol=0.2)
    assert np.abs(slow - motion)[400:-400].max() < 2 * size
    known = np.arange(4000) % every == 0
    assert not noise.values[~known].any()
    assert all(np.corrcoef(noise.values[known, joint], true[known, joint])[0, 1] > 0.8 for joint in range(2))
    # What is not known of the noise is of the size that the draws have.
    missed = true - noise.values
    inside = np.abs(np.arange(4000) - 2000) < 1600
    for steps in (known & inside, ~known & inside):
        if steps.any():
            np.testing.assert_allclose(noise.errors[:, steps].std((0, 1)), missed[steps].std(0), rtol=0.3)


def test_efforts_are_exact_at_the_rows():
    time = DT * np.arange(4000)
    true = np.random.default_rng(0).standard_normal((4000, 1))
    slow, noise = split(time[::2], (np.sin(6 * time)[:, None] + true)[::2], time, given=True)
    assert noise.errors.shape == (DRAWS, 4000, 1)
    assert not noise.errors[:, ::2].any()
    missed = np.sin(6 * time)[:, None] + true - slow - noise.values
    assert np.abs(missed[400:-400:2]).max() < 1e-9
    np.testing.assert_allclose(noise.errors[:, 1::2].std(), missed[1::2].std(), rtol=0.1)
    slow, noise = split(time, true, time, given=True)
    assert not len(noise.errors)


def test_rows_that_are_far_apart_tell_no_noise():
    time = DT * np.arange(4000)
    rows = time[:: round(0.3 / NOISE_CUTOFF / DT)]
    slow, noise = split(rows, np.sin(rows)[:, None], time)
    assert not noise.size.any()
    assert not len(noise.errors)
    np.testing.assert_allclose(slow[:, 0], np.sin(time), atol=1e-2)
