"""Figures show the measured values of any run."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from batchpid.errors import InvalidArgumentError
from batchpid.sim import Observation, Rollout, RunInfo, plots

TICKS, ENVS = 30, 6


def make(joints=3, ticks=TICKS, envs=ENVS, seed=0, **info):
    random = np.random.default_rng(seed)
    shape = (ticks, envs, joints)
    seen = Observation(
        qpos=random.uniform(0, 1.5, shape),
        qvel=np.zeros(shape),
        effort=random.uniform(-9, 9, shape),
        saturated=random.random(shape) < 0.2,
        ok=np.ones(shape[:2], bool),
        guarded=np.zeros(shape, bool),
    )
    about = RunInfo(
        robot="arm",
        joint_names=tuple(f"joint{index}" for index in range(joints)),
        units=("rad", "m", "rad", "rad", "m")[:joints] if joints < 6 else ("rad",) * joints,
        lower=np.full(joints, -2.0),
        upper=np.full(joints, 2.0),
        effort_limit=np.full(joints, 10.0),
    )
    time = 0.01 * np.arange(1, ticks + 1)
    return Rollout(time, np.ones(shape), seen, tick=0.01, info=replace(about, **info))


def split_axes(figure):
    """Return the axes titled with a joint's name, and all others."""
    named = [axes for axes in figure.axes if axes.get_title(loc="left")]
    return named, [axes for axes in figure.axes if axes not in named]


def test_every_joint_has_its_axes_in_its_units():
    rollout = make(2)
    named, others = split_axes(plots.step_responses(rollout))
    assert [axes.get_title(loc="left") for axes in named] == list(rollout.info.joint_names)
    assert [axes.get_ylabel() for axes in named] == ["rad", "m"]
    assert [axes.get_ylabel() for axes in others] == ["N m", "N"]


def is_drawn(axes, values):
    """Return whether one of the lines has these values."""
    lines = [np.asarray(line.get_ydata(), float) for line in axes.lines]
    return any(
        line.shape == values.shape and np.allclose(line, values, equal_nan=True) for line in lines
    )


def test_fan_holds_every_env_and_the_line_is_the_median():
    rollout = make()
    named, others = split_axes(plots.step_responses(rollout))
    for joint, (above, below) in enumerate(zip(named, others, strict=True)):
        for axes, values in ((above, rollout.qpos), (below, rollout.effort)):
            (fan,) = (c for c in axes.collections if type(c).__name__ == "LineCollection")
            drawn = np.array([segment[:, 1] for segment in fan.get_segments()])
            np.testing.assert_array_equal(drawn, values[..., joint].T)
            assert is_drawn(axes, np.median(values[..., joint], 1))
        low, high = above.get_ylim()
        assert low < rollout.qpos[..., joint].min() < rollout.qpos[..., joint].max() < high
        assert below.get_ylim()[0] < -10 < 10 < below.get_ylim()[1]


def test_limits_far_from_the_efforts_do_not_flatten_them():
    _, (axes,) = split_axes(plots.step_responses(make(1, effort_limit=np.array([1e4]))))
    assert axes.get_ylim()[1] < 20


def test_a_run_that_diverges_is_shown_near_its_limits():
    rollout = make(1)
    rollout.qpos[10:, 0] = 1e30
    (axes,), _ = split_axes(plots.step_responses(rollout))
    assert axes.get_ylim()[1] < 4


def test_setpoints_that_are_efforts_are_not_drawn_as_positions():
    rollout = make(1, control="effort")
    rollout.setpoint[:] = 80.0
    (axes,), _ = split_axes(plots.step_responses(rollout))
    assert axes.get_ylim()[1] < 2
    assert not is_drawn(axes, rollout.setpoint[:, 0, 0])


@pytest.mark.slow
@settings(max_examples=4, deadline=None)
@given(
    bad=st.sampled_from([np.nan, np.inf, -np.inf, 1e38]),
    first=st.integers(0, TICKS - 1),
    envs=st.integers(1, ENVS),
    limits=st.sampled_from([1.0, np.inf]),
    unit=st.sampled_from(["rad", "m"]),
    control=st.sampled_from(["pid", "effort"]),
)
def test_any_run_can_be_drawn(tmp_path_factory, bad, first, envs, limits, unit, control):
    limit = np.array([limits])
    rollout = make(1, units=(unit,), lower=-limit, upper=limit, effort_limit=limit, control=control)
    rollout.qpos[first:, :envs] = bad
    rollout.effort[first:, :envs] = bad
    rollout.setpoint[first:, 0] = bad
    folder = tmp_path_factory.mktemp("plots")
    for name, figure in (
        ("step", plots.step_responses(rollout)),
        ("two", plots.step_responses(rollout, make(1), labels=["a", "b"])),
    ):
        assert plots.save(figure, folder / f"{name}.png", dpi=40).stat().st_size > 1000


def test_nothing_is_drawn_of_an_env_after_it_failed():
    rollout = make(2)
    rollout.ok[10:, 2] = False
    figure = plots.step_responses(rollout)
    left = np.where(rollout.ok, rollout.qpos[..., 0], np.nan)
    assert is_drawn(split_axes(figure)[0][0], np.nanmedian(left, axis=1))
    for axes in figure.axes:
        for fan in (c for c in axes.collections if type(c).__name__ == "LineCollection"):
            drawn = np.array([path.vertices[:, 1] for path in fan.get_paths()])
            np.testing.assert_array_equal(np.isnan(drawn.T), ~rollout.ok)


def test_two_runs_may_have_other_lengths_but_not_other_joints():
    runs = make(1), make(1, ticks=2 * TICKS, envs=2)
    figure = plots.step_responses(*runs, labels=("run", "other"))
    assert all(axes.get_xlim()[1] == pytest.approx(0.6) for axes in figure.axes)
    legend = [text.get_text() for text in figure.legends[0].get_texts()]
    assert {"run: each env", "run: median", "other: median"} <= {*legend}
    legend = plots.step_responses(*runs).legends[0].get_texts()
    assert "second: median" in [text.get_text() for text in legend]
    with pytest.raises(InvalidArgumentError, match="joint1"):
        plots.step_responses(make(1), make(2))


def test_joints_by_name():
    rollout = make()
    named, _ = split_axes(plots.step_responses(rollout, joints=["joint2", "joint0"]))
    assert [axes.get_title(loc="left") for axes in named] == ["joint2", "joint0"]
    with pytest.raises(InvalidArgumentError, match="use one of 'joint0'"):
        plots.step_responses(rollout, joints=["joint9"])


@pytest.mark.slow
def test_png_and_svg(tmp_path):
    figure = plots.step_responses(make(1), title="one joint")
    png = plots.save(figure, tmp_path / "a" / "b" / "run.png")
    svg = plots.save(figure, str(tmp_path / "run.SVG"))
    with Image.open(png) as picture:
        assert picture.format == "PNG"
    assert "one joint" in svg.read_text()
    with pytest.raises(InvalidArgumentError, match=r"\.png or \.svg"):
        plots.save(figure, tmp_path / "run.pdf")
