"""What goes into a panel: the envs as a fan, setpoint, limits, efforts; and the part of the axis that is shown."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, to_rgba
from numpy.typing import ArrayLike, NDArray

from sim.plots.traces import Traces

ENV = "#4c78a8"
MEDIAN = "#16324f"
MARKED = "#f28e2b"
SECOND = "#e45756"
SETPOINT = "#2f8f4e"
LIMIT = "#b23a48"
SMALL = 7.0
"""Font size of ticks and units."""


def draw_fan(axes: Axes, time: NDArray[Any], values: NDArray[Any], mark: int | None) -> None:
    """Every env as a thin line, the median as a bold one, ``mark`` apart."""
    lines = np.empty((values.shape[1], len(time), 2))
    lines[..., 0], lines[..., 1] = time, values.T
    alpha = min(0.9, max(0.08, 12.0 / len(lines)))
    # As one bitmap: an SVG of 64 envs by 9 joints would hold half a million points.
    axes.add_collection(
        LineCollection(list(lines), colors=ENV, linewidths=0.6, alpha=alpha, rasterized=True), autolim=False
    )
    axes.plot(time, quantile(values, 0.5), color=MEDIAN, lw=1.5)
    if mark is not None:
        axes.plot(time, values[:, mark], color=MARKED, lw=1.1)


def draw_band(axes: Axes, time: NDArray[Any], values: NDArray[Any], colour: str) -> None:
    """The median of the envs as a line, 10 to 90 % of them as a band."""
    axes.fill_between(time, quantile(values, 0.1), quantile(values, 0.9), color=colour, alpha=0.2, lw=0)
    axes.plot(time, quantile(values, 0.5), color=colour, lw=1.4)


def draw_setpoint(axes: Axes, traces: Traces, joint: int, band: float | None) -> None:
    """The setpoint, one line where all envs share it; around its last value the settling band."""
    setpoint = traces.setpoint[..., joint]
    shared = (setpoint == setpoint[:, :1]).all()
    axes.plot(traces.time, setpoint[:, 0] if shared else setpoint, color=SETPOINT, lw=1.1, ls="--", zorder=3)
    move = np.abs(setpoint[-1] - traces.qpos[0, :, joint])
    if band is not None and shared and np.isfinite(move).any():
        half = band * float(np.nanmedian(move))
        axes.axhspan(setpoint[-1, 0] - half, setpoint[-1, 0] + half, color=SETPOINT, alpha=0.2, lw=0)


def draw_limits(axes: Axes, low: float, high: float) -> None:
    """A line at each finite limit, and hatching beyond."""
    for limit, sign in ((low, -1), (high, 1)):
        if math.isfinite(limit):
            far = limit + sign * 1e3 * max(1.0, abs(limit))
            axes.axhspan(limit, far, fc="none", ec=LIMIT, alpha=0.25, hatch="////", lw=0, zorder=0)
            axes.axhline(limit, color=LIMIT, lw=0.9, zorder=2)


def draw_efforts(axes: Axes, traces: Traces, joint: int, mark: int | None) -> None:
    """A joint's efforts as a fan against its limit, with the share of envs in saturation as a strip above."""
    values, limit = traces.effort[..., joint], float(traces.effort_limit[joint])
    draw_limits(axes, -limit, limit)
    draw_fan(axes, traces.time, values, mark)
    view_efforts(axes, values, traces, joint)
    share = traces.saturated[..., joint].mean(1)
    if share.any():
        strip = axes.inset_axes((0, 0.97, 1, 0.06))
        strip.imshow(share[None], aspect="auto", cmap=_saturation_colours(), vmin=0, vmax=1, interpolation="nearest")
        strip.set_axis_off()
    peak = np.max(np.abs(values), initial=0.0, where=np.isfinite(values))
    if math.isfinite(limit):
        note = f"peak {peak / limit:.0%} of ±{limit:g} {traces.effort_unit(joint)}"
    else:
        note = f"peak {peak:.3g} {traces.effort_unit(joint)}, no limit"
    # Out of the way of the curves' ends.
    low, high = axes.get_ylim()
    ends = values[2 * len(values) // 3 :]
    above = np.mean(ends, where=np.isfinite(ends)) < (low + high) / 2 if np.isfinite(ends).any() else False
    axes.text(
        0.99,
        0.86 if above else 0.1,
        note,
        transform=axes.transAxes,
        ha="right",
        va="top" if above else "bottom",
        fontsize=6.5,
        color="#444444",
        bbox={"fc": "white", "ec": "none", "alpha": 0.75, "pad": 0.6},
    )


def _saturation_colours() -> Any:
    return LinearSegmentedColormap.from_list("saturation", [to_rgba(LIMIT, 0.0), to_rgba(LIMIT, 0.9)])


# -- what part of the axis is shown ------------------------------------------------------------------------------


def view(axes: Axes, values: NDArray[Any], traces: Traces, joint: int) -> None:
    """Show the positions, but of a run that flies off only a little beyond the limits (or two turns)."""
    setpoint = traces.setpoint[..., joint]
    low, high = traces.lower[joint], traces.upper[joint]
    turn = 4 * np.pi if traces.units[joint] == "rad" else 1.0
    low = low if math.isfinite(low) else setpoint.min() - turn
    high = high if math.isfinite(high) else setpoint.max() + turn
    room = 0.15 * (high - low)
    low, high = min(low - room, setpoint.min()), max(high + room, setpoint.max())
    _set_view(axes, np.clip(values[np.isfinite(values)], low, high))
    axes.set_ylabel(traces.units[joint], fontsize=SMALL)


def view_efforts(axes: Axes, values: NDArray[Any], traces: Traces, joint: int) -> None:
    """Show the efforts, and their limit too where it is not many times farther."""
    limit, finite = float(traces.effort_limit[joint]), values[np.isfinite(values)]
    peak = np.abs(finite).max(initial=0.0)
    reach = [limit, -limit] if math.isfinite(limit) and peak > 0.2 * limit else []
    _set_view(axes, np.append(finite, [0.0, *reach]))
    axes.set_ylabel(traces.effort_unit(joint), fontsize=SMALL)


def _set_view(axes: Axes, values: NDArray[Any]) -> None:
    if values.size:
        low, high = float(values.min()), float(values.max())
        room = 0.08 * (high - low) or 0.05 * max(abs(high), 1e-3)
        axes.set_ylim(low - room, high + room)


def quantile(values: ArrayLike, q: float) -> NDArray[Any]:
    """Quantile over envs (axis 1) of what is finite; NaN where nothing is."""
    table = np.sort(np.where(np.isfinite(values), values, np.nan), axis=1)  # NaN last
    count = np.isfinite(table).sum(1)
    place = q * np.maximum(count - 1, 0)
    low = np.floor(place).astype(int)
    high = np.minimum(low + 1, np.maximum(count - 1, 0))
    rows = np.arange(len(table))
    result = table[rows, low] + (place - low) * (table[rows, high] - table[rows, low])
    return np.where(count > 0, result, np.nan)
