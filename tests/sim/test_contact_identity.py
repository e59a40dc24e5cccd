"""In contact, too, at many places at once and without order, the number of workers changes no byte."""

from __future__ import annotations

import numpy as np

from sim import Robot, Runner

JACO = Robot.load("jaco2")
N = 16


def thrash(workers):
    """Random efforts, far beyond what the fingers' links can bear in peace."""
    effort = 5 * np.random.default_rng(0).normal(size=(30, N, JACO.dof))
    params = JACO.params(kp=0.0, ki=0.0, kd=0.0, effort_limit=None)
    with Runner(JACO, N, workers=workers, control="effort", params=params, checkpoint_steps=300) as runner:
        return runner.rollout(effort)


def test_for_any_number_of_workers():
    ours, theirs = thrash(0), thrash(3)
    assert np.abs(ours.qvel).max() > 10
    for name, first, second in zip(ours._fields, ours, theirs, strict=True):
        np.testing.assert_array_equal(first, second, name)
