"""Parts of the control panel: names, requests, charts, gains, and the reason why a robot has not settled."""

from types import SimpleNamespace

import numpy as np
import pytest

from batchpid.errors import InvalidArgumentError
from batchpid.sim import Observation, Rollout, Runner
from batchpid.sim.view import LiveSimulation, Playback
from batchpid.sim.view.gains import GroupGains, offered_gains
from batchpid.sim.view.page import Charts
from batchpid.sim.view.panel import MAX_REQUESTS, Requests, cause, short_names

BELOW = np.array([0, 1.7, 0, -1.2, 0, 1.5, 0, 0.02, 0.02])


def test_joint_names_lose_the_words_that_all_share(panda, jaco2):
    assert short_names(panda) == (*(f"joint{k}" for k in range(1, 8)), "finger_joint1", "finger_joint2")
    assert short_names(jaco2)[6:8] == ("joint_7", "finger_1")


def test_requests_run_in_order_and_one_that_fails_is_named():
    done, refused = [], []
    requests = Requests(refused.append)

    def fail():
        raise InvalidArgumentError("kp", "is odd", remedy="try another")

    for request in (lambda: done.append(1), fail, lambda: requests.put(lambda: done.append(3)), lambda: done.append(2)):
        requests.put(request)
    requests.run()
    assert done == [1, 2]
    assert refused == ["kp: is odd; try another"]
    requests.run()
    assert done == [1, 2, 3]


def test_more_requests_than_fit_are_refused():
    done, refused = [], []
    requests = Requests(refused.append)
    for number in range(MAX_REQUESTS + 5):
        requests.put(lambda number=number: done.append(number))
    requests.run()
    assert done == list(range(MAX_REQUESTS))
    assert len(refused) == 5


def advance(live, seconds):
    for _ in range(round(seconds / live.period)):
        live.advance()


def test_a_robot_that_is_moved_into_the_ground(panda):
    live = LiveSimulation(panda, 2, workers=0, engine="mujoco", spread=0.0)
    try:
        advance(live, 2.2)
        assert cause(live, 0) == ""
        live.set_setpoint(BELOW, env=1)
        advance(live, 1.0)
        assert cause(live, 1) == ""  # it may be on its way
        advance(live, 1.2)
        assert cause(live, 0) == ""
        assert "is pressed into the ground" in cause(live, 1)
        assert "env 0" in cause(live, 1)
    finally:
        live.close()


def test_a_target_out_of_reach(panda):
    live = LiveSimulation(panda, 1, controls=("osc",), workers=0, engine="mujoco", spread=0.0)
    try:
        live.set_target([2.0, 0.0, 0.5, 0.0, 1.0, 0.0, 0.0])
        advance(live, 2.2)
        assert "no pose within the joint limits" in cause(live, 0)
    finally:
        live.close()


@pytest.mark.parametrize("env", [0, 1])
def test_a_recorded_run(panda, env):
    setpoints = np.tile([panda.start, BELOW], (210, 1, 1))
    with Runner(panda, 2, workers=0, engine="mujoco", substeps=20) as runner:
        playback = Playback(runner.rollout(setpoints), panda)
    playback.seek(playback.duration)
    assert ("is pressed into the ground" in cause(playback, env)) == (env == 1)


class Gui:
    """The part of viser's gui that Charts uses."""

    def __init__(self):
        self.charts = []

    def add_uplot(self, data, series, **options):
        self.charts.append(SimpleNamespace(data=data, series=series, **options))
        return self.charts[-1]


@pytest.fixture
def draw(jaco2):
    """Return a function that draws the charts of a sine wave of some height."""

    def draw(height):
        time = np.linspace(0.02, 1.0, 50)
        wave = np.repeat((height * np.sin(9 * time))[:, None, None], jaco2.dof, axis=2).astype(np.float32)
        ok = np.ones((50, 1), bool)
        seen = Observation(wave, wave, wave, wave > 9e9, ok, wave > 9e9)
        playback = Playback(Rollout(time, 0.0 * wave.astype(float), seen, 0.02, jaco2.run_info()), jaco2)
        playback.seek(1.0)
        gui = Gui()
        Charts(gui, playback).update(0, 6)
        return gui.charts

    return draw


def test_charts_are_flat_before_the_first_update(jaco2):
    ok = np.ones((2, 1), bool)
    rest = np.zeros((2, 1, jaco2.dof), np.float32)
    gui = Gui()
    seen = Observation(rest, rest, rest, rest > 0, ok, rest > 0)
    Charts(gui, Playback(Rollout(np.array([0.1, 0.2]), 0.0 * rest, seen, 0.1, jaco2.run_info()), jaco2))
    assert all(np.ptp(curve) == 0 for chart in gui.charts for curve in chart.data[1:])


@pytest.mark.parametrize("height", [1e-7, 0.3, 18.0])
def test_curves_are_finite_one_for_each_series(draw, height):
    charts = draw(height)
    for chart in charts:
        assert len(chart.data) == len(chart.series)
        assert all(np.isfinite(column).all() for column in chart.data)  # a gap would empty the chart
    position, error, effort = charts
    assert (position.title, effort.title) == ("j2s7s300_joint_7 [rad]", "effort [N m]")
    np.testing.assert_allclose(position.data[1], -error.data[1], atol=6e-5)


def test_near_limits_are_drawn_and_far_ones_repeat_the_curve(draw):
    time, lower, upper, effort = draw(18.0)[2].data
    assert (lower == -20).all()
    assert (upper == 20).all()
    time, lower, upper, effort = draw(0.3)[2].data
    assert time[-1] == 0
    np.testing.assert_array_equal(lower, effort)
    np.testing.assert_array_equal(upper, effort)


def test_noise_at_rest_is_a_flat_line(draw):
    assert np.ptp(draw(1e-5)[0].data[1]) == 0


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
