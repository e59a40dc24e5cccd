"""Candidates of a search for gains of operational-space control."""

from __future__ import annotations

import numpy as np
import pytest
from robots import load_bundled

import batchpid.task_space as ts
from batchpid.sim import OperationalSpace
from batchpid.sim.tuning.tool_candidates import GAINS, SearchedSpace, osc_options, stability_penalty

HAND = "panda_hand"


@pytest.fixture(scope="module")
def panda():
    return load_bundled("panda")


def test_gains_of_a_setpoint_are_those_of_the_options(panda):
    """Each env has the effort of a controller that is made with its gains; the defaults are the library's."""
    rng, searched = np.random.default_rng(0), SearchedSpace(panda, HAND)
    gains = rng.uniform(0.5, 2, (3, 5)) * [value for _, value in GAINS.values()]
    gains[0] = [value for _, value in GAINS.values()]
    qpos, qvel = panda.settings.target + 0.1 * rng.normal(size=(2, 3, 9))
    pose = ts.link_poses(searched.tree, qpos + 0.05, [HAND])[:, 0]
    inputs = searched.init(panda, 3), np.concatenate([pose, gains], axis=1), qpos, qvel, np.zeros((3, 9))
    efforts = searched(*inputs)[1]
    for row, given in enumerate(gains):
        alone = OperationalSpace(panda, HAND, **osc_options(given) if row else {})
        state, *rest = inputs
        part = ts.OSCState(state.posture[row : row + 1]), pose[row : row + 1], *(x[row : row + 1] for x in rest[1:])
        np.testing.assert_allclose(efforts[row], alone(*part)[1][0], rtol=1e-12, atol=1e-9)


def test_gains_near_the_stability_bound_have_a_penalty():
    """With ratio 1 the explicit law is stable for w dt < 0.828."""
    gains = np.array([[0.828, 0.1, 0.1, 1, 1], [0.1, 0.828, 0.1, 1, 1], [0.1, 0.1, 0.828, 1, 1], [0.3, 0.3, 0.3, 1, 1]])
    np.testing.assert_allclose(stability_penalty(gains * [1e3, 1e3, 1e3, 1, 1], 1e-3), [2, 2, 2, 0], atol=0.01)
