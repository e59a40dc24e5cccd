"""The charts: what they draw of a joint, and what would spoil them."""

from types import SimpleNamespace

import numpy as np
import pytest

from sim import Robot
from sim.view import Playback
from sim.view.charts import Charts


class Gui:
    """What Charts asks of viser's gui."""

    def __init__(self):
        self.charts = []

    def add_uplot(self, data, series, **options):
        self.charts.append(SimpleNamespace(data=data, series=series, **options))
        return self.charts[-1]


@pytest.fixture
def shown():
    """The three charts after so many rows of a wave of this height."""

    def shown(height, rows=50):
        from sim import Observation, Rollout

        robot = Robot.load("jaco2")
        time = np.linspace(0.02, 1.0, 50)
        wave = np.repeat((height * np.sin(9 * time))[:, None, None], robot.dof, axis=2).astype(np.float32)
        ok = np.ones((50, 1), bool)
        seen = Observation(wave, wave, wave, wave > 9e9, ok)
        playback = Playback(robot, Rollout(time, 0.0 * wave.astype(float), seen, 0.02, robot.run_info()))
        playback.seek(float(time[rows - 1] - time[0]))
        gui = Gui()
        charts = Charts(gui, playback)
        charts.show(0, 6)
        return charts, gui.charts

    return shown


@pytest.mark.parametrize("height", [1e-7, 0.3, 18.0])
def test_what_is_drawn_is_finite_and_has_a_series(shown, height):
    _, charts = shown(height)
    for chart in charts:
        assert len(chart.data) == len(chart.series)
        assert all(np.isfinite(column).all() for column in chart.data)  # a gap would empty the chart
    position, error, effort = charts
    assert (position.title, effort.title) == ("j2s7s300_joint_7 [rad]", "effort [N m]")
    np.testing.assert_allclose(position.data[1], -error.data[1], atol=6e-5)


def test_near_limits_are_drawn_and_far_ones_lie_under_the_curve(shown):
    time, lower, upper, effort = shown(18.0)[1][2].data
    assert (lower == -20).all()
    assert (upper == 20).all()
    time, lower, upper, effort = shown(0.3)[1][2].data
    assert time[-1] == 0
    np.testing.assert_array_equal(lower, effort)
    np.testing.assert_array_equal(upper, effort)


def test_noise_at_rest_is_a_flat_line(shown):
    assert np.ptp(shown(1e-5)[1][0].data[1]) == 0
