"""Gains on the page: the sets that are offered, and changes of single gains."""

import numpy as np
import pytest

from batchpid.errors import InvalidArgumentError
from batchpid.sim.view.gains import GroupGains, offered_gains


def test_the_robots_gains_are_offered_after_the_given_ones(panda):
    sets = offered_gains(panda, "pid", None)
    assert list(sets) == ["tuned", "designed", "tutorial"]
    np.testing.assert_array_equal(sets["designed"].kp, panda.designed().kp)
    assert list(offered_gains(panda, "pid", panda.params(kp=50.0))) == ["given", *sets]
    assert list(offered_gains(panda, "drive", None)) == ["tutorial"]


def test_params_of_several_rows_are_refused(panda):
    with pytest.raises(InvalidArgumentError, match="params"):
        offered_gains(panda, "pid", panda.params(kp=np.ones((2, panda.dof))))


def test_a_set_replaces_all_params(panda):
    designed = panda.designed()
    gains = GroupGains(panda, {"given": panda.params(kp=50.0, deadband=1e-3), "designed": designed})
    assert list(gains.sets) == ["given", "designed"]
    assert (gains.params.kp == 50.0).all()
    gains.apply_set("designed")
    for ours, theirs in zip(gains.params, designed, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    with pytest.raises(InvalidArgumentError, match="name"):
        gains.apply_set("tutorial")


def test_a_gain_is_set_on_one_joint(panda):
    gains = GroupGains(panda, {"tutorial": panda.params()})
    gains.set("kp", 0, 77.0)
    gains.set("effort_limit", 1, 5.0)
    assert gains.params.kp[0, :2].tolist() == [77.0, panda.settings.kp[1]]
    assert gains.params.effort_min[0, :2].tolist() == [-87.0, -5.0]
    assert gains.params.effort_max[0, :2].tolist() == [87.0, 5.0]
    with pytest.raises(InvalidArgumentError, match="gain"):
        gains.set("deadband", 0, 0.1)
    for gain, joint, value in (("kp", 0, -1.0), ("kp", 0, np.nan), ("kp", 9, 1.0), ("ki", 0, "1"), ("ki", 0, [1, 2])):
        with pytest.raises(InvalidArgumentError):
            gains.set(gain, joint, value)
    gains.apply_set("tutorial")
    np.testing.assert_array_equal(gains.params.kp[0], panda.settings.kp)


def test_limits_that_differ_up_and_down_are_kept(panda):
    gains = GroupGains(panda, {"given": panda.params(effort_min=-3.0, effort_max=7.0)})
    gains.set("kp", 0, 77.0)
    shifted = gains.params_under(np.full((2, panda.dof), 0.5))
    assert np.unique(shifted.effort_min).tolist() == [-2.5]
    assert np.unique(shifted.effort_max).tolist() == [7.5]


def test_a_filter_or_weight_switched_off_stays_part_of_the_law(panda):
    gains = GroupGains(panda, {"tutorial": panda.params()})
    for joint in range(panda.dof):
        gains.set("derivative_filter_time", joint, 0.0)
        gains.set("setpoint_weight", joint, 1.0)
    assert gains.params.derivative_filter_time is not None
    assert gains.params.setpoint_weight is not None


def test_sliders_reach_beyond_every_set_in_the_same_units(panda):
    gains = GroupGains(panda, {"tutorial": panda.params(), "tuned": panda.tuned()})
    value, end = gains.slider_range("kp", 0)
    assert (value, end) == (panda.settings.kp[0], 4 * panda.settings.kp[0])
    assert gains.slider_range("effort_limit", 0) == (87.0, 87.0)
    assert gains.slider_range("setpoint_weight", 0)[1] == 1.0
    assert gains.slider_range("derivative_filter_time", 0)[1] == 0.02


def test_the_implicit_law_has_no_filter_to_change(panda):
    params = panda.params(kp=400.0, kd=40.0, gain_units="mass_matrix", discretization="implicit")
    gains = GroupGains(panda, {"given": params})
    gains.set("kp", 0, 77.0)
    gains.set("derivative_filter_time", 0, 0.01)
    assert gains.params.derivative_filter_time is None
    assert gains.params.discretization == params.discretization
