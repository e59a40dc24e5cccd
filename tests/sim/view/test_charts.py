"""Charts of one joint: finite curves, limits, noise."""

from types import SimpleNamespace

import numpy as np
import pytest

from batchpid.sim import Observation, Rollout
from batchpid.sim.view import Playback
from batchpid.sim.view.page import Charts


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
