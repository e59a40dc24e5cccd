"""Pictures: what is drawn is what was measured, and no run is too odd to draw."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image

from batchpid.errors import InvalidArgumentError
from sim import plots
from sim.plots.drawing import MEDIAN, quantile

TICKS, ENVS = 30, 6


def make(joints=3, ticks=TICKS, envs=ENVS, seed=0):
    random = np.random.default_rng(seed)
    shape = (ticks, envs, joints)
    return plots.Traces(
        time=0.01 * np.arange(1, ticks + 1),
        setpoint=np.ones(shape),
        qpos=random.uniform(0, 1.5, shape),
        effort=random.uniform(-9, 9, shape),
        saturated=random.random(shape) < 0.2,
        joint_names=tuple(f"joint{index}" for index in range(joints)),
        units=("rad", "m", "rad", "rad", "m")[:joints] if joints < 6 else ("rad",) * joints,
        lower=np.full(joints, -2.0),
        upper=np.full(joints, 2.0),
        effort_limit=np.full(joints, 10.0),
        label="run",
    )


def panels(figure):
    """The panels with a joint's name, and all others."""
    named = [axes for axes in figure.axes if axes.get_title(loc="left")]
    return named, [axes for axes in figure.axes if axes not in named]


@pytest.mark.parametrize("joints", [1, 2, 9, 13])
def test_every_joint_has_its_panels(joints):
    traces = make(joints)
    named, others = panels(plots.step_responses(traces, mark=0))
    assert [axes.get_title(loc="left") for axes in named] == list(traces.joint_names)
    assert len(others) == joints
    named, others = panels(plots.efforts(traces))
    assert (len(named), len(others)) == (joints, 0)


def test_fan_holds_every_env_and_the_line_is_the_median():
    traces = make()
    named, others = panels(plots.step_responses(traces))
    for joint, (above, below) in enumerate(zip(named, others, strict=True)):
        for axes, values in ((above, traces.qpos), (below, traces.effort)):
            (fan,) = (c for c in axes.collections if type(c).__name__ == "LineCollection")
            drawn = np.array([segment[:, 1] for segment in fan.get_segments()])
            np.testing.assert_array_equal(drawn, values[..., joint].T)
            medians = [line.get_ydata() for line in axes.lines if line.get_color() == MEDIAN]
            np.testing.assert_allclose(medians, [np.median(values[..., joint], 1)])
        low, high = above.get_ylim()
        assert low < traces.qpos[..., joint].min() < traces.qpos[..., joint].max() < high
        assert below.get_ylim()[0] < -10 < 10 < below.get_ylim()[1]


def test_settling_band_is_a_fraction_of_the_median_move():
    traces = make(1)
    traces.qpos[0] = 0.0
    (axes,), _ = panels(plots.step_responses(traces, band=0.05))
    (band,) = (p for p in axes.patches if p.get_alpha() == 0.2)
    assert band.get_y() == pytest.approx(0.95)
    assert band.get_height() == pytest.approx(0.1)


def test_limits_far_from_the_efforts_do_not_flatten_them():
    traces = dataclasses.replace(make(1), effort_limit=np.array([1e4]))
    (axes,), _ = panels(plots.efforts(traces))
    assert axes.get_ylim()[1] < 20
    assert any("of ±10000 N m" in text.get_text() for text in axes.texts)


def test_a_run_that_flies_off_is_shown_near_its_limits():
    traces = make(1)
    traces.qpos[10:, 0] = 1e30
    (axes,), _ = panels(plots.step_responses(traces))
    assert axes.get_ylim()[1] < 4


@given(hnp.arrays(np.float64, (7, 5), elements=st.floats(-1e6, 1e6) | st.just(np.nan)), st.floats(0, 1))
def test_quantile_is_that_of_what_is_finite(values, q):
    got = quantile(values, q)
    for row, value in zip(values, got, strict=True):
        finite = row[np.isfinite(row)]
        if finite.size:
            assert value == pytest.approx(np.quantile(finite, q), rel=1e-9, abs=1e-9)
        else:
            assert np.isnan(value)


@settings(max_examples=8, deadline=None)
@given(
    bad=st.sampled_from([np.nan, np.inf, -np.inf, 1e38]),
    first=st.integers(0, TICKS - 1),
    envs=st.integers(1, ENVS),
    limits=st.sampled_from([1.0, np.inf]),
    unit=st.sampled_from(["rad", "m"]),
)
def test_no_run_is_too_odd_to_draw(tmp_path_factory, bad, first, envs, limits, unit):
    traces = make(1)
    traces.qpos[first:, :envs] = bad
    traces.effort[first:, :envs] = bad
    traces = dataclasses.replace(
        traces,
        units=(unit,),
        lower=np.array([-limits]),
        upper=np.array([limits]),
        effort_limit=np.array([limits]),
    )
    folder = tmp_path_factory.mktemp("plots")
    for name, figure in (
        ("step", plots.step_responses(traces, mark=0)),
        ("efforts", plots.efforts(traces, mark=1)),
        ("comparison", plots.comparison(traces, make(1))),
    ):
        assert plots.save(figure, folder / f"{name}.png", dpi=40).stat().st_size > 1000


def test_traces_of_a_rollout_blank_what_came_after_a_divergence():
    from sim import Observation, Robot, Rollout

    robot = Robot.load("panda")
    shape = (TICKS, ENVS, robot.dof)
    ok = np.ones(shape[:2], bool)
    ok[10:, 2] = False
    zeros = np.zeros(shape, np.float32)
    seen = Observation(zeros, zeros, zeros, zeros > 0, ok)
    rollout = Rollout(np.arange(1.0, TICKS + 1), zeros.astype(float), seen, tick=1.0, info=robot.run_info())
    traces = plots.Traces.of(rollout, robot, "run")
    np.testing.assert_array_equal(np.isnan(traces.qpos).all(2), ~ok)
    np.testing.assert_array_equal(np.isnan(traces.effort).any(2), ~ok)
    assert traces.joint_names == robot.joint_names
    assert traces.units[-1] == "m"
    assert traces.effort_unit(8) == "N"


def test_comparison_takes_runs_of_other_lengths_but_not_of_other_joints():
    figure = plots.comparison(make(2), dataclasses.replace(make(2, ticks=2 * TICKS, envs=2), label="other"))
    assert all(axes.get_xlim()[1] == pytest.approx(0.6) for axes in figure.axes)
    legend = [text.get_text() for text in figure.legends[0].get_texts()]
    assert legend[:2] == ["run: median, 10 to 90 %", "other: median, 10 to 90 %"]
    with pytest.raises(InvalidArgumentError, match="joint2"):
        plots.comparison(make(2), make(3))


def test_joints_by_name_or_index():
    traces = make()
    assert traces.chosen(["joint2", 0]) == [2, 0]
    named, _ = panels(plots.step_responses(traces, joints=["joint1"]))
    assert [axes.get_title(loc="left") for axes in named] == ["joint1"]
    for unknown in ("joint9", 3, -1):
        with pytest.raises(InvalidArgumentError, match="joint0, joint1, joint2"):
            plots.efforts(traces, joints=[unknown])


def test_png_and_svg(tmp_path):
    figure = plots.step_responses(make(2), title="two joints")
    png = plots.save(figure, tmp_path / "a" / "b" / "run.png")
    svg = plots.save(figure, str(tmp_path / "run.SVG"))
    with Image.open(png) as picture:
        assert picture.format == "PNG"
    assert "two joints" in svg.read_text()
    with pytest.raises(InvalidArgumentError, match=r"\.png or \.svg"):
        plots.save(figure, tmp_path / "run.pdf")
