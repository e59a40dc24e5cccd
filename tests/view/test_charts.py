"""The charts' axes: wide enough for what is drawn, never for noise alone, and calm."""

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
        from sim import Rollout

        robot = Robot.load("jaco2")
        time = np.linspace(0.02, 1.0, 50)
        wave = np.repeat((height * np.sin(9 * time))[:, None, None], robot.dof, axis=2).astype(np.float32)
        ok = np.ones((50, 1), bool)
        playback = Playback(robot, Rollout(time, 0.0 * wave.astype(float), wave, wave, wave, wave > 9e9, ok))
        playback.seek(float(time[rows - 1] - time[0]))
        gui = Gui()
        charts = Charts(gui, playback)
        charts.show(0, 6)
        return charts, gui.charts

    return shown


@pytest.mark.parametrize("height", [1e-7, 0.3, 18.0])
def test_the_axis_covers_the_curve_and_more_than_noise(shown, height):
    _, (position, error, effort) = shown(height)
    for chart in (position, error, effort):
        low, high = chart.scales["y"]["range"]
        assert low < -0.9 * height
        assert high > 0.9 * height
        assert high - low >= 0.02
        assert high - low < 5 * height + 0.5
        assert all(np.isfinite(column).all() for column in chart.data)
        assert len(chart.data) == len(chart.series)
    assert (position.title, effort.title) == ("j2s7s300_joint_7 [rad]", "effort [N m]")


def test_near_limits_are_in_sight_and_far_ones_are_not(shown):
    low, high = shown(18.0)[1][2].scales["y"]["range"]
    assert low < -20
    assert high > 20
    assert shown(0.3)[1][2].scales["y"]["range"][1] < 1


def test_the_axis_stays_while_the_curve_fits(shown):
    charts, (position, *_) = shown(1.0)
    before = position.scales
    charts.show(0, 6)
    assert position.scales is before
    charts._fit(position, -0.1, 0.1, 0.02)
    assert position.scales["y"]["range"] == pytest.approx((-0.12, 0.12))
