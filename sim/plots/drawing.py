"""Parts of a figure: the envs as a fan or a band, setpoints, limits and efforts, and the range of
an axis.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, to_rgba

from batchpid.arrays.array_types import Rows
from batchpid.sim.signals.observation import OBSERVED
from batchpid.sim.signals.rollout import Rollout, RunInfo

ENV = "#4c78a8"
MEDIAN = "#16324f"
MARKED = "#f28e2b"
SECOND = "#e45756"
SETPOINT = "#2f8f4e"
LIMIT = "#b23a48"
SMALL = 7.0
"""Font size of ticks and units."""
_NOTE: Any = {
    "fontsize": 6.5,
    "color": "#444444",
    "bbox": {"fc": "white", "ec": "none", "alpha": 0.75, "pad": 0.6},
}


def draw_fan(axes: Axes, time: Rows, values: Rows, mark: int | None) -> None:
    """Draw each env of ``values`` (ticks, envs) as a thin line, their median as a bold one, env
    ``mark`` in colour.
    """
    lines = np.empty((values.shape[1], len(time), 2))
    lines[..., 0], lines[..., 1] = time, values.T
    alpha = min(0.9, max(0.08, 12.0 / len(lines)))
    # As one bitmap: an SVG of 64 envs by 9 joints would hold half a million points.
    axes.add_collection(
        LineCollection(list(lines), colors=ENV, linewidths=0.6, alpha=alpha, rasterized=True),
        autolim=False,
    )
    axes.plot(time, *quantiles(values, 0.5), color=MEDIAN, lw=1.5)
    if mark is not None:
        axes.plot(time, values[:, mark], color=MARKED, lw=1.1)


def draw_band(axes: Axes, time: Rows, values: Rows, colour: str) -> None:
    """Draw the median of the envs as a line, and 10 to 90 % of them as a band."""
    low, median, high = quantiles(values, 0.1, 0.5, 0.9)
    axes.fill_between(time, low, high, color=colour, alpha=0.2, lw=0)
    axes.plot(time, median, color=colour, lw=1.4)


def draw_setpoint(axes: Axes, run: Rollout, joint: int, band: float | None) -> None:
    """Draw the setpoint of a joint, and the settling band around its last value."""
    setpoint = run.setpoint[..., joint]
    shared = draw_entry(axes, run.time, setpoint)
    move = np.abs(setpoint[-1] - run.qpos[0, :, joint])
    move = move[np.isfinite(move)]
    if band is not None and shared and move.size:
        half = band * float(np.median(move))
        axes.axhspan(
            setpoint[-1, 0] - half, setpoint[-1, 0] + half, color=SETPOINT, alpha=0.2, lw=0
        )


def draw_entry(axes: Axes, time: Rows, values: Rows) -> bool:
    """Draw one number of the setpoints (ticks, envs), as one line where all envs share it; return
    whether they do.
    """
    shared = bool((values == values[:, :1]).all())
    axes.plot(time, values[:, 0] if shared else values, color=SETPOINT, lw=1.1, ls="--", zorder=3)
    return shared


def draw_limits(axes: Axes, low: float, high: float) -> None:
    """Draw a line at each finite limit, and hatching beyond it."""
    for limit, sign in ((low, -1), (high, 1)):
        if math.isfinite(limit):
            far = limit + sign * 1e3 * max(1.0, abs(limit))
            axes.axhspan(limit, far, fc="none", ec=LIMIT, alpha=0.25, hatch="////", lw=0, zorder=0)
            axes.axhline(limit, color=LIMIT, lw=0.9, zorder=2)


def draw_efforts(axes: Axes, run: Rollout, joint: int, mark: int | None) -> None:
    """Draw the efforts as a fan against their limit, with the share of envs in saturation as a
    strip at the top.
    """
    values, limit = run.effort[..., joint], float(run.info.effort_limit[joint])
    draw_limits(axes, -limit, limit)
    draw_fan(axes, run.time, values, mark)
    set_effort_range(axes, [run], joint)
    share = run.saturated[..., joint].mean(1)
    if share.any():
        strip = axes.inset_axes((0, 0.97, 1, 0.06))
        colours = LinearSegmentedColormap.from_list(
            "saturation", [to_rgba(LIMIT, 0.0), to_rgba(LIMIT, 0.9)]
        )
        strip.imshow(
            share[None], aspect="auto", cmap=colours, vmin=0, vmax=1, interpolation="nearest"
        )
        strip.set_axis_off()
    peak, unit = (
        np.max(np.abs(values), initial=0.0, where=np.isfinite(values)),
        _effort_unit(run.info, joint),
    )
    note = f"peak {peak:.3g} {unit}, no limit"
    if math.isfinite(limit):
        note = f"peak {peak / limit:.0%} of ±{limit:g} {unit}"
    # The note goes where the curves do not end.
    low, high = axes.get_ylim()
    ends = values[2 * len(values) // 3 :]
    above = (
        np.mean(ends, where=np.isfinite(ends)) < (low + high) / 2
        if np.isfinite(ends).any()
        else False
    )
    height, anchor = (0.86, "top") if above else (0.1, "bottom")
    axes.text(0.99, height, note, transform=axes.transAxes, ha="right", va=anchor, **_NOTE)


def set_position_range(axes: Axes, runs: Sequence[Rollout], joint: int) -> None:
    """Show all positions and the first run's setpoints, but no more than 15 % beyond the limits.

    A limit that is infinite is taken two turns, or 1 m, beyond the setpoints.
    """
    info, positions = runs[0].info, _joint_values(runs, "qpos", joint)
    setpoints = _joint_values(runs[:1], "setpoint", joint)
    targets = setpoints if setpoints.size else np.zeros(1)
    low, high = info.lower[joint], info.upper[joint]
    far = 4 * np.pi if info.units[joint] == "rad" else 1.0
    low = low if math.isfinite(low) else targets.min() - far
    high = high if math.isfinite(high) else targets.max() + far
    margin = 0.15 * (high - low)
    low, high = min(low - margin, targets.min()), max(high + margin, targets.max())
    _set_range(axes, np.clip(np.append(positions, setpoints), low, high))
    axes.set_ylabel(info.units[joint], fontsize=SMALL)


def set_effort_range(axes: Axes, runs: Sequence[Rollout], joint: int) -> None:
    """Show all efforts, and the limit of the first run unless it is more than five times as far."""
    info, efforts = runs[0].info, _joint_values(runs, "effort", joint)
    limit = float(info.effort_limit[joint])
    near = math.isfinite(limit) and np.abs(efforts).max(initial=0.0) > 0.2 * limit
    _set_range(axes, np.append(efforts, [0.0, limit, -limit] if near else [0.0]))
    axes.set_ylabel(_effort_unit(info, joint), fontsize=SMALL)


def quantiles(values: Rows, *at: float) -> Rows:
    """Return quantiles over the finite envs of ``values`` (ticks, envs), (len(at), ticks); NaN
    without finite envs.
    """
    finite = np.where(np.isfinite(values), values, np.nan)
    if not np.isnan(finite).any():  # nanquantile is many times slower
        return np.quantile(finite, at, axis=1)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "All-NaN slice")
        return np.nanquantile(finite, at, axis=1)


def _joint_values(runs: Sequence[Rollout], name: str, joint: int) -> Rows:
    values = np.concatenate([getattr(run, name)[..., joint].ravel() for run in runs])
    return values[np.isfinite(values)]


def _effort_unit(info: RunInfo, joint: int) -> str:
    return OBSERVED["effort"].unit_for(info.units[joint])


def _set_range(axes: Axes, values: Rows) -> None:
    if values.size:
        low, high = float(values.min()), float(values.max())
        margin = 0.08 * (high - low) or 0.05 * max(abs(high), 1e-3)
        axes.set_ylim(low - margin, high + margin)
