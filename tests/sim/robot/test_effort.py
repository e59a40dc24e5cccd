"""Effort limits of designed gains, where the URDF gives none."""

import numpy as np
import pytest
from tiny_urdf import LIMIT, joint, link, one_joint, robot, write

import batchpid as bp
from batchpid.sim import Robot

UNLIMITED = LIMIT.replace('effort="10"', "")
OFF_CENTRE = (
    '<inertial><origin xyz="0.5 0 0"/><mass value="2"/><inertia ixx="0.1" iyy="0.1"'
    ' izz="0.1"/></inertial>'
)


def test_the_suggested_limit_is_that_of_its_formula(tmp_path):
    """A mass of 2 kg at 0.5 m, level at q = 0: gravity 9.81 N m, inertia 0.1 + 2 * 0.5^2 = 0.6 kg
    m^2.
    """
    text = one_joint(UNLIMITED + '<dynamics friction="0.5" damping="0.2"/>', arm=OFF_CENTRE)
    free = Robot.load(write(tmp_path, text))
    assert free.effort_limit == np.inf
    expected = 2 * (9.81 + 0.5) + 3 * 0.2 + 30 * 0.6
    assert free.design_effort_limit == pytest.approx(expected, rel=1e-2)  # over sampled poses


def test_stated_limits_are_kept_and_designed_gains_have_both(tmp_path):
    parts = (
        link("base"),
        link("a"),
        link("b"),
        joint("j", "base", "a"),
        joint("k", "a", "b", inner=UNLIMITED),
    )
    mixed = Robot.load(write(tmp_path, robot(*parts)))
    stated, suggested = mixed.design_effort_limit
    assert stated == 10
    assert np.isfinite(suggested)
    assert suggested > 0
    for params in (mixed.designed(), bp.design_gains(mixed, 2.0)):
        np.testing.assert_array_equal(np.squeeze(params.effort_max), [stated, suggested])
    assert bp.design_gains(mixed, 2.0, effort_limit=None).effort_max is None
    assert np.isinf(np.squeeze(mixed.params(kp=1.0).effort_max)[1])
