"""Figures of runs: responses of one run or of two.

Everything is drawn by Matplotlib's object interface on the Agg and SVG canvases: no display, no
global state. Every artist with a meaning has a label, from which the legend is made.
"""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from batchpid.arrays.array_types import Rows
from batchpid.checks import choice, file_path
from batchpid.errors import InvalidArgumentError
from batchpid.io.files import write_atomically
from batchpid.sim.signals import OBSERVED

if TYPE_CHECKING:
    from batchpid.sim.rollout import Rollout

FORMATS = (".png", ".svg")
"""Suffixes of the files that :func:`save` writes."""
FIRST = ("#4c78a8", "#16324f")
SECOND = ("#e45756", "#8c2226")
"""Colours of a run's envs, and of their median."""
SETPOINT = "#2f8f4e"
LIMIT = "#b23a48"
SMALL = 7.0
"""Font size of ticks and units."""


class Picture(Figure):
    """Figure that a notebook shows as PNG, without pyplot."""

    def _repr_png_(self) -> bytes:
        file = io.BytesIO()
        self.savefig(file, format="png", dpi=90)
        return file.getvalue()


def step_responses(
    *rollouts: Rollout,
    labels: Sequence[str] = (),
    joints: Sequence[str] = (),
    title: str = "",
) -> Figure:
    """Draw, for each joint, positions against setpoint and limits above efforts against their
    limit; two runs of the same joints over each other, with the setpoints and limits of the first.

    Setpoints that are not one number for each joint have separate axes, one for each entry of the
    command, with the pose of the tool where there is one. Not-finite samples are gaps; so is
    everything of an env from where ``ok`` is False.

    Parameters
    ----------
    labels
        Names of two runs.
    joints
        Names; default all.

    Raises
    ------
    InvalidArgumentError
        The robot has no such joint, or the runs have different joints.
    """
    runs = [_blank_failed(rollout) for rollout in rollouts]
    run = runs[0]
    names = run.info.joint_names
    for other in runs[1:]:
        if other.info.joint_names != names:
            problem = f"have the joints {', '.join(other.info.joint_names)}, too"
            remedy = f"compare runs with the joints {', '.join(names)}"
            raise InvalidArgumentError("rollouts", problem, remedy=remedy)
    prefixes = [""]
    if len(runs) > 1:
        prefixes = [f"{label}: " for label in labels or ("first", "second")]
    command = run.info.own_command
    entries = []
    if command is not None and not run.info.sets_positions:
        entries = [f"setpoint {label}" for label in command.labels]
    chosen = [names.index(choice("joints", joint, names)) for joint in joints or names]
    titles = [*(names[index] for index in chosen), *entries]
    figure, blocks = _grid(titles, title, max(run.time[-1] for run in runs))
    # Joints come first, entries of another command after them.
    for joint, (above, below) in zip(chosen, blocks, strict=False):
        _draw_positions(above, runs, prefixes, joint)
        _draw_efforts(below, runs, prefixes, joint)
    pose = run.tool_pose
    setpoint = rollouts[0].setpoint
    if pose is not None:
        # Of the two quaternions of an orientation, the one that is nearer to the setpoint's.
        products = (pose[..., 3:] * setpoint[..., 3:7]).sum(-1, keepdims=True)
        signs = np.where(products < 0, -1.0, 1.0)
        pose = np.concatenate([pose[..., :3], signs * pose[..., 3:]], axis=-1)
    for entry, (above, below) in enumerate(blocks[len(chosen) :]):
        _draw_setpoint(above, run.time, setpoint[..., entry])
        if pose is not None and entry < pose.shape[-1]:
            _draw_fan(above, run.time, pose[..., entry])
        below.remove()
    _add_legend(figure)
    return figure


def save(figure: Figure, path: str | Path, dpi: int = 110) -> Path:
    """Write ``figure`` to ``path`` (.png or .svg) as a whole or not at all, making its folder, and
    return the path.

    Raises
    ------
    InvalidArgumentError
        Another suffix.
    OSError
        The file cannot be written.
    """
    path = file_path("path", path, FORMATS)
    path.parent.mkdir(parents=True, exist_ok=True)
    suffix = path.suffix.lower()[1:]
    write_atomically(path, lambda file: figure.savefig(file, dpi=dpi, format=suffix))
    return path


# -- parts of a figure


def _grid(
    names: Sequence[str],
    title: str,
    end: float,
) -> tuple[Figure, list[list[Axes]]]:
    """Return a figure, and for each of ``names`` a column of two axes, positions above
    efforts, up to the time ``end`` [s].
    """
    columns = min(len(names), 3)
    lines = math.ceil(len(names) / columns)
    heights = (1.7, 0.85)
    figure = Picture(figsize=(4.0 * columns, sum(heights) * lines + 0.8), layout="constrained")
    figure.suptitle(_plain(title), fontsize=11)
    grid = figure.add_gridspec(lines * 2, columns, height_ratios=heights * lines)
    blocks = []
    for place, name in enumerate(names):
        line, column = divmod(place, columns)
        block = [figure.add_subplot(grid[2 * line + row, column]) for row in range(2)]
        for axes in block:
            axes.tick_params(
                labelsize=SMALL,
                length=2,
                labelbottom=axes is block[-1],
            )
            axes.spines[["top", "right"]].set_visible(False)
            axes.set_xlim(0, end)
            axes.yaxis.set_major_locator(MaxNLocator(4))
        block[0].set_title(
            _plain(name),
            fontsize=8,
            loc="left",
            pad=3,
            fontweight="bold",
        )
        # The lowest axes of a column have the unit of time.
        if place + columns >= len(names):
            block[-1].set_xlabel("time [s]", fontsize=SMALL)
        blocks.append(block)
    return figure, blocks


def _plain(text: str) -> str:
    """Return ``text`` so that Matplotlib draws it as it is, where two ``$`` begin a formula."""
    return text.replace("$", r"\$")


def _add_legend(figure: Figure) -> None:
    """Add a legend with each label of the figure's artists once."""
    entries: dict[str, Any] = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(_plain(label), handle)
    figure.legend(
        entries.values(),
        entries.keys(),
        loc="outside lower center",
        ncols=max(1, int(figure.get_figwidth() / 2)),
        fontsize=7.5,
        frameon=False,
    )


def _draw_fan(
    axes: Axes,
    time: Rows,
    values: Rows,
    label: str = "",
    colours: tuple[str, str] = FIRST,
) -> None:
    """Draw each env of ``values`` (ticks, envs) as a thin line, their median as a bold one."""
    lines = [np.stack([time, value], axis=1) for value in values.T]
    # As one bitmap: an SVG of 64 envs by 9 joints would hold half a million points.
    fan = LineCollection(
        lines,
        colors=colours[0],
        linewidths=0.6,
        alpha=min(0.9, max(0.08, 12.0 / len(lines))),
        rasterized=True,
        label=f"{label}each env",
    )
    axes.add_collection(fan, autolim=False)
    # Infinity counts as missing: a median of two of them would be NaN with a warning.
    finite = np.where(np.isfinite(values), values, np.nan)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "All-NaN slice")
        median = np.nanmedian(finite, axis=1)
    axes.plot(time, median, color=colours[1], lw=1.5, label=f"{label}median")


def _draw_setpoint(axes: Axes, time: Rows, values: Rows) -> None:
    """Draw one number of the setpoints (ticks, envs), as one line where all envs share it."""
    if (values == values[:, :1]).all():
        values = values[:, :1]
    shown = np.where(np.isfinite(values), values, np.nan)
    lines = axes.plot(time, shown, color=SETPOINT, lw=1.1, ls="--", zorder=3)
    # One label for all lines: a legend names the setpoint once.
    lines[0].set_label("setpoint")


def _draw_limits(axes: Axes, low: float, high: float) -> None:
    """Draw a line at each finite limit."""
    for limit in (low, high):
        if math.isfinite(limit):
            axes.axhline(
                limit,
                color=LIMIT,
                lw=0.9,
                zorder=2,
                label="limit",
            )


def _draw_positions(
    axes: Axes,
    runs: Sequence[Rollout],
    labels: Sequence[str],
    joint: int,
) -> None:
    """Draw positions, and setpoints and limits of the first run. The axes hold all of them, but no
    positions more than 15 % beyond the limits.
    """
    info = runs[0].info
    low = info.lower[joint]
    high = info.upper[joint]
    setpoint = runs[0].setpoint[..., joint]
    _draw_limits(axes, low, high)
    _draw_setpoint(axes, runs[0].time, setpoint)
    margin = 0.15 * (high - low)
    # Setpoints outside the limits are worth seeing, a run that diverges is not.
    far = np.append(_finite(setpoint), [low - margin, high + margin])
    shown = [_finite(setpoint)]
    for run, label, colours in zip(runs, labels, (FIRST, SECOND), strict=False):
        values = run.qpos[..., joint]
        _draw_fan(axes, run.time, values, label, colours)
        shown.append(np.clip(_finite(values), far.min(), far.max()))
    _show(axes, np.concatenate(shown), info.units[joint])


def _draw_efforts(
    axes: Axes,
    runs: Sequence[Rollout],
    labels: Sequence[str],
    joint: int,
) -> None:
    """Draw efforts against the limit of the first run."""
    info = runs[0].info
    limit = float(info.effort_limit[joint])
    _draw_limits(axes, -limit, limit)
    for run, label, colours in zip(runs, labels, (FIRST, SECOND), strict=False):
        _draw_fan(axes, run.time, run.effort[..., joint], label, colours)
    values = np.concatenate([_finite(run.effort[..., joint]) for run in runs])
    peak = np.abs(values).max(initial=0.0)
    # A limit far away would flatten the curve.
    ends = [limit, -limit] if peak > 0.2 * limit else []
    unit = OBSERVED["effort"].unit_for(info.units[joint])
    _show(axes, np.concatenate([values, [0.0], ends]), unit)


def _show(axes: Axes, values: Rows, unit: str) -> None:
    """Set the range of the axes so that it holds the finite ``values``, and their unit."""
    axes.set_ylabel(_plain(unit), fontsize=SMALL)
    finite = _finite(values)
    if finite.size:
        low = float(finite.min())
        high = float(finite.max())
        margin = 0.08 * (high - low) or 0.05 * max(abs(high), 1e-3)
        axes.set_ylim(low - margin, high + margin)


def _finite(values: Rows) -> Rows:
    """Return the finite values, in one row."""
    return values[np.isfinite(values)]


def _blank_failed(rollout: Rollout) -> Rollout:
    """Return the rollout with NaN where an env has failed, and for setpoints that are not
    positions.

    Raises InvalidArgumentError for one without ticks.
    """
    rollout.check_ticks()
    alive = rollout.ok[..., None]
    blank = {}
    for name in ("qpos", "effort", "tool_pose"):
        values = getattr(rollout, name)
        if values is not None:
            blank[name] = np.where(alive, values, np.nan)
    setpoint = np.full(rollout.qpos.shape, np.nan)
    if rollout.info.sets_positions:
        setpoint = rollout.setpoint
    observation = rollout.observation._replace(**blank)
    return replace(rollout, setpoint=setpoint, observation=observation)
