"""Figures of runs: step responses, efforts against their limits, two runs compared, errors of an
identification.

Everything is drawn by Matplotlib's object interface on the Agg and SVG canvases: no display, no
global state.
"""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from PIL import Image

from batchpid.arrays.array_types import Array, Float64
from batchpid.checks.validate import file_path
from batchpid.errors import InvalidArgumentError
from batchpid.io.files import write_atomically
from batchpid.sim.plots import drawing
from batchpid.sim.signals.command import CommandSpec
from batchpid.sim.signals.rollout import Rollout

FORMATS = (".png", ".svg")
"""Suffixes of the files that :func:`save` writes."""


class Picture(Figure):
    """Figure that a notebook shows as PNG, without pyplot."""

    def _repr_png_(self) -> bytes:
        return _png(self, dpi=90)


Joints: TypeAlias = Sequence[int | str] | None
"""Joints to draw, by index or name; None or empty for all."""
_MEDIAN = Line2D([], [], color=drawing.MEDIAN, lw=1.6, label="median")
_SETPOINT = Line2D([], [], color=drawing.SETPOINT, lw=1.2, ls="--", label="setpoint")
_BEYOND = Patch(fc="none", ec=drawing.LIMIT, hatch="////", lw=0, label="beyond the limits")
_SATURATION = Patch(color=drawing.LIMIT, alpha=0.6, lw=0, label="share of envs in saturation")


def step_responses(
    rollout: Rollout,
    *,
    joints: Joints = None,
    band: float = 0.02,
    mark: int | None = None,
    title: str = "",
) -> Figure:
    """Draw, for each joint, positions against setpoint and limits above efforts against their
    limit.

    Setpoints that are not one number for each joint have separate axes, one for each entry of the
    command, with the pose of the tool where there is one. Not-finite samples are gaps; so is
    everything of an env from where ``ok`` is False.

    Parameters
    ----------
    joints
        Indices or names; default all.
    band
        Half width of the settling band around the last setpoint, as a fraction of the median move.
    mark
        An env to draw in a colour apart.

    Raises
    ------
    InvalidArgumentError
        The robot has no such joint.
    """
    run = _blank_failed(rollout)
    command = None if run.info.sets_positions else run.info.own_command
    figure, blocks = _figure(run, joints, rows=2, title=title, command=command)
    own_blocks = blocks[len(blocks) - command.size :] if command is not None else []
    pose = (
        None
        if run.tool_pose is None
        else _like_setpoints(run.tool_pose, rollout.setpoint[..., 3:7])
    )
    for entry, (axes,) in own_blocks:
        values = rollout.setpoint[..., entry]
        drawing.draw_entry(axes, run.time, np.where(np.isfinite(values), values, np.nan))
        if pose is not None and entry < pose.shape[-1]:
            drawing.draw_fan(axes, run.time, pose[..., entry], mark)
    for joint, (above, below) in blocks[: len(blocks) - len(own_blocks)]:
        drawing.draw_limits(above, run.info.lower[joint], run.info.upper[joint])
        drawing.draw_setpoint(above, run, joint, band)
        drawing.draw_fan(above, run.time, run.qpos[..., joint], mark)
        drawing.set_position_range(above, [run], joint)
        drawing.draw_efforts(below, run, joint, mark)
    settling = Patch(
        color=drawing.SETPOINT, alpha=0.2, lw=0, label=f"settling band, {band:.0%} of the move"
    )
    _legend(figure, [*_fan_entries(run, mark), _SETPOINT, settling, _BEYOND, _SATURATION])
    return figure


def efforts(
    rollout: Rollout, *, joints: Joints = None, mark: int | None = None, title: str = ""
) -> Figure:
    """Draw, for each joint, efforts against their limit, and the share of envs in saturation.

    Parameters as in :func:`step_responses`.
    """
    run = _blank_failed(rollout)
    figure, blocks = _figure(run, joints, rows=1, title=title)
    for joint, (axes,) in blocks:
        drawing.draw_efforts(axes, run, joint, mark)
    limit = Line2D([], [], color=drawing.LIMIT, lw=1.0, label="limit")
    _legend(figure, [*_fan_entries(run, mark), limit, _SATURATION])
    return figure


def following_errors(rollout: Rollout, *, joints: Joints = None, title: str = "") -> Figure:
    """Draw, for each joint, position minus setpoint at the ends of the ticks, where a setpoint
    holds.

    Parameters as in :func:`step_responses`.
    """
    run = _blank_failed(rollout)
    figure, blocks = _figure(run, joints, rows=1, title=title)
    for joint, (axes,) in blocks:
        error = run.qpos[..., joint] - run.setpoint[..., joint]
        drawing.draw_fan(axes, run.time, error, None)
        axes.autoscale(axis="y")
        axes.set_ylabel(run.info.units[joint], fontsize=drawing.SMALL)
    _legend(figure, _fan_entries(run, None))
    return figure


def comparison(
    first: Rollout,
    second: Rollout,
    *,
    labels: tuple[str, str] = ("first", "second"),
    joints: Joints = None,
    title: str = "",
) -> Figure:
    """Draw median and 10 to 90 % of the envs of two runs of the same joints, positions above
    efforts.

    Raises
    ------
    InvalidArgumentError
        The runs have different joints, or the robot has no such joint.
    """
    ours, theirs = first.info.joint_names, second.info.joint_names
    if ours != theirs:
        raise InvalidArgumentError(
            "second",
            f"has the joints {', '.join(theirs)}, the first run {', '.join(ours)}",
            remedy="compare runs of the same robot",
        )
    runs, info = [_blank_failed(first), _blank_failed(second)], first.info
    colours = (drawing.ENV, drawing.SECOND)
    figure, blocks = _figure(runs[0], joints, rows=2, title=title)
    for joint, (above, below) in blocks:
        drawing.draw_limits(above, info.lower[joint], info.upper[joint])
        drawing.draw_setpoint(above, runs[0], joint, None)
        drawing.draw_limits(below, -info.effort_limit[joint], info.effort_limit[joint])
        for run, colour in zip(runs, colours, strict=True):
            drawing.draw_band(above, run.time, run.qpos[..., joint], colour)
            drawing.draw_band(below, run.time, run.effort[..., joint], colour)
        drawing.set_position_range(above, runs, joint)
        drawing.set_effort_range(below, runs, joint)
        for axes in (above, below):
            axes.set_xlim(0, max(first.time[-1], second.time[-1]))
    bands = [
        Line2D([], [], color=colour, lw=1.6, label=f"{label}: median, 10 to 90 %")
        for label, colour in zip(labels, colours, strict=True)
    ]
    _legend(figure, [*bands, _SETPOINT, _BEYOND])
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
    if path.suffix.lower() == ".svg":
        write_atomically(path, lambda file: figure.savefig(file, dpi=dpi, format="svg"))
        return path
    write_atomically(path, _png(figure, dpi))
    return path


def _png(figure: Figure, dpi: int) -> bytes:
    """Return the figure as a PNG file."""
    figure.set_dpi(dpi)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    image = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    # A palette of 256 colours looks the same, and takes a third of the bytes.
    image = image.quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    file = io.BytesIO()
    image.save(file, "PNG", optimize=True, dpi=(dpi, dpi))
    return file.getvalue()


def _blank_failed(rollout: Rollout) -> Rollout:
    """Return the rollout with NaN where an env has failed, and for setpoints that are not
    positions.
    """
    alive, seen = rollout.ok[..., None], rollout.observation
    blank = seen._replace(
        qpos=np.where(alive, seen.qpos, np.nan),
        effort=np.where(alive, seen.effort, np.nan),
        tool_pose=None if seen.tool_pose is None else np.where(alive, seen.tool_pose, np.nan),
    )
    setpoint = np.full(seen.qpos.shape, np.nan)
    if rollout.info.sets_positions:
        setpoint = np.where(np.isfinite(rollout.setpoint), rollout.setpoint, np.nan)
    return replace(rollout, setpoint=setpoint, observation=blank)


def _like_setpoints(pose: Array, wxyz: Array) -> Any:
    """Return poses (..., 7) with the sign of the quaternion that is nearer to ``wxyz`` (..., 4)."""
    sign = np.where((pose[..., 3:] * wxyz).sum(-1, keepdims=True) < 0, -1.0, 1.0)
    return np.concatenate([pose[..., :3], sign * pose[..., 3:]], axis=-1)


def _joint_indices(run: Rollout, joints: Joints) -> list[int]:
    names = run.info.joint_names
    indices: dict[int | str, int] = {
        key: index for index, name in enumerate(names) for key in (name, index)
    }
    for joint in joints or ():
        if joint not in indices:
            raise InvalidArgumentError(
                "joints", "no such joint", value=joint, remedy=f"use {', '.join(names)}"
            )
    return [indices[joint] for joint in joints or names]


def _figure(
    run: Rollout, joints: Joints, *, rows: int, title: str, command: CommandSpec | None = None
) -> tuple[Figure, list[tuple[int, list[Axes]]]]:
    """Return a figure with ``rows`` axes for each joint, then one for each entry of ``command``, in
    a grid.

    The pairs are (joint, axes) and, after these, (entry, axes).
    """
    chosen = [(joint, run.info.joint_names[joint], rows) for joint in _joint_indices(run, joints)]
    if command is not None:
        chosen += [(entry, f"setpoint {label}", 1) for entry, label in enumerate(command.labels)]
    # Up to three columns; with more than 9 joints four or five, which leaves the fewest empty
    # cells.
    columns = (
        min(len(chosen), 3) if len(chosen) <= 9 else min((4, 5), key=lambda n: -len(chosen) % n)
    )
    lines = math.ceil(len(chosen) / columns)
    heights = (1.7, 0.85)[:rows]
    between = 0.06  # a thin empty row separates the joints
    size = ((4.0 if columns < 5 else 3.6) * columns, (sum(heights) + between) * lines + 0.75)
    figure = Picture(figsize=size, layout="constrained")
    figure.get_layout_engine().set(h_pad=0.02, w_pad=0.05, hspace=0.0)  # type: ignore[call-arg, union-attr]
    if title:
        figure.suptitle(title, fontsize=11)
    # One flat grid, so that the axes of a column are aligned.
    grid = figure.add_gridspec(
        lines * (rows + 1), columns, height_ratios=(*heights, between) * lines
    )
    blocks = []
    for place, (index, name, parts) in enumerate(chosen):
        line, column = divmod(place, columns)
        first = line * (rows + 1)
        cells = [slice(first, first + rows)] if parts < rows else range(first, first + rows)
        block = [figure.add_subplot(grid[cell, column]) for cell in cells]
        last = place + columns >= len(chosen)
        for axes in block:
            axes.tick_params(
                labelsize=drawing.SMALL, length=2, labelbottom=axes is block[-1] and last
            )
            axes.spines[["top", "right"]].set_visible(False)
            axes.set_xlim(0, run.time[-1])
            axes.yaxis.set_major_locator(MaxNLocator(4))
        if last:
            block[-1].set_xlabel("time [s]", fontsize=drawing.SMALL)
        block[0].set_title(name, fontsize=8, loc="left", pad=3, fontweight="bold")
        blocks.append((index, block))
    return figure, blocks


def _fan_entries(run: Rollout, mark: int | None) -> list[Line2D]:
    line = Line2D(
        [], [], color=drawing.ENV, alpha=0.6, lw=0.8, label=f"each of {run.num_envs} envs"
    )
    marked = (
        [] if mark is None else [Line2D([], [], color=drawing.MARKED, lw=1.2, label=f"env {mark}")]
    )
    return [line, *marked, _MEDIAN]


def _legend(figure: Figure, handles: list[Any]) -> None:
    # As many columns as the figure is wide enough for: an entry of n letters takes about n + 8 of
    # them.
    letters = figure.get_figwidth() * 17
    columns = max(
        1,
        min(len(handles), int(letters / (8 + max(len(handle.get_label()) for handle in handles)))),
    )
    if sum(len(handle.get_label()) + 8 for handle in handles) < letters:
        columns = len(handles)
    figure.legend(
        handles=handles, loc="outside lower center", ncols=columns, fontsize=7.5, frameon=False
    )


class FitErrors(NamedTuple):
    """Position errors along a simulated stretch of a log: measured less simulated positions."""

    time: Float64
    """Times (rows,) [s]."""
    fitted: NDArray[np.bool_]
    """Rows that were fitted; the others were kept to judge (rows,)."""
    before: Float64
    """Of the robot as its description says (rows, joints) [rad or m]."""
    after: Float64
    """Of the robot as identified."""


def fit_errors(
    fits: Sequence[FitErrors], names: Sequence[str], units: Sequence[str], title: str
) -> Figure:
    """Draw the position errors of the joints ``names`` along the stretches of one log, before and
    after.

    The part that was kept to judge is shaded.
    """
    columns = min(3, len(names))
    rows = math.ceil(len(names) / columns)
    figure = Picture(figsize=(4.2 * columns, 0.8 + 2.0 * rows), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False, sharex=True)
    held_out = [fit.time[~fit.fitted] for fit in fits]
    for number, axes in enumerate(grid.flat):
        if number >= len(names):
            axes.set_axis_off()
            continue
        for label, colour in (("before", drawing.SECOND), ("after", drawing.ENV)):
            for index, fit in enumerate(fits):
                error = np.maximum(np.abs(getattr(fit, label)[:, number]), 1e-9)
                error[~np.isfinite(error)] = np.nan
                every = max(1, len(error) // 2000)
                axes.semilogy(
                    fit.time[::every],
                    error[::every],
                    color=colour,
                    lw=0.8,
                    label=label if index == 0 else None,
                )
        for times in held_out:
            if len(times):
                axes.axvspan(times[0], times[-1], color=drawing.SETPOINT, alpha=0.15, lw=0)
        axes.set_title(names[number], fontsize=drawing.SMALL)
        axes.set_ylabel(units[number], fontsize=drawing.SMALL)
    figure.supxlabel("time [s]", fontsize=drawing.SMALL)
    figure.suptitle(title, fontsize=drawing.SMALL + 2)
    grid.flat[0].legend(fontsize=drawing.SMALL)
    return figure
