"""Pictures of a run: step responses, efforts against their limits, and two runs side by side.

Everything is drawn by Matplotlib's object interface on the Agg and SVG canvases: no display, no global state.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from PIL import Image

from batchpid.errors import InvalidArgumentError
from sim.plots import drawing
from sim.plots.traces import Traces

__all__ = ["Traces", "check_path", "comparison", "efforts", "save", "step_responses"]

FORMATS = (".png", ".svg")


def step_responses(
    traces: Traces,
    *,
    joints: Sequence[int | str] | None = None,
    band: float = 0.02,
    mark: int | None = None,
    title: str = "",
) -> Figure:
    """For each joint, positions against setpoint and limits above efforts against their limit.

    Parameters
    ----------
    joints
        Indices or names; default all.
    band
        Half width of the settling band around the last setpoint, as a fraction of the median move.
    mark
        An env to draw apart from the fan.
    """
    figure, blocks = _figure(traces, joints, rows=2, title=title)
    for joint, (above, below) in blocks:
        _name(above, traces, joint)
        drawing.draw_limits(above, traces.lower[joint], traces.upper[joint])
        drawing.draw_setpoint(above, traces, joint, band)
        drawing.draw_fan(above, traces.time, traces.qpos[..., joint], mark)
        drawing.view(above, np.stack([traces.qpos[..., joint], traces.setpoint[..., joint]]), traces, joint)
        drawing.draw_efforts(below, traces, joint, mark)
    median = Line2D([], [], color=drawing.MEDIAN, lw=1.6, label="median")
    _legend(
        figure,
        [
            Line2D([], [], color=drawing.ENV, alpha=0.6, lw=0.8, label=f"each of {traces.num_envs} envs"),
            *([] if mark is None else [Line2D([], [], color=drawing.MARKED, lw=1.2, label=f"env {mark}")]),
            median,
            Line2D([], [], color=drawing.SETPOINT, lw=1.2, ls="--", label="setpoint"),
            Patch(color=drawing.SETPOINT, alpha=0.2, lw=0, label=f"settling band, {band:.0%} of the move"),
            Patch(fc="none", ec=drawing.LIMIT, hatch="////", lw=0, label="beyond the limits"),
            Patch(color=drawing.LIMIT, alpha=0.6, lw=0, label="share of envs in saturation"),
        ],
    )
    return figure


def efforts(
    traces: Traces, *, joints: Sequence[int | str] | None = None, mark: int | None = None, title: str = ""
) -> Figure:
    """For each joint, efforts against their limit, and the share of envs in saturation."""
    figure, blocks = _figure(traces, joints, rows=1, title=title)
    for joint, (axes,) in blocks:
        _name(axes, traces, joint)
        drawing.draw_efforts(axes, traces, joint, mark)
    _legend(
        figure,
        [
            Line2D([], [], color=drawing.ENV, alpha=0.6, lw=0.8, label=f"each of {traces.num_envs} envs"),
            Line2D([], [], color=drawing.MEDIAN, lw=1.6, label="median"),
            Line2D([], [], color=drawing.LIMIT, lw=1.0, label="limit"),
            Patch(color=drawing.LIMIT, alpha=0.6, lw=0, label="share of envs in saturation"),
        ],
    )
    return figure


def comparison(first: Traces, second: Traces, *, joints: Sequence[int | str] | None = None, title: str = "") -> Figure:
    """Two runs of the same joints: median and 10 to 90 % of the envs, positions above efforts.

    Raises
    ------
    InvalidArgumentError
        The runs have different joints.
    """
    if first.joint_names != second.joint_names:
        raise InvalidArgumentError(
            "second",
            f"has the joints {', '.join(second.joint_names)}, the first run {', '.join(first.joint_names)}",
            remedy="compare runs of the same robot",
        )
    runs = ((first, drawing.ENV, first.label or "first"), (second, drawing.SECOND, second.label or "second"))
    figure, blocks = _figure(first, joints, rows=2, title=title)
    for joint, (above, below) in blocks:
        _name(above, first, joint)
        drawing.draw_limits(above, first.lower[joint], first.upper[joint])
        drawing.draw_setpoint(above, first, joint, None)
        drawing.draw_limits(below, -first.effort_limit[joint], first.effort_limit[joint])
        for run, colour, _ in runs:
            drawing.draw_band(above, run.time, run.qpos[..., joint], colour)
            drawing.draw_band(below, run.time, run.effort[..., joint], colour)
        both = [run.qpos[..., joint].ravel() for run, _, _ in runs]
        drawing.view(above, np.concatenate([*both, first.setpoint[..., joint].ravel()]), first, joint)
        drawing.view_efforts(
            below, np.concatenate([run.effort[..., joint].ravel() for run, _, _ in runs]), first, joint
        )
        for axes in (above, below):
            axes.set_xlim(0, max(first.time[-1], second.time[-1]))
    _legend(
        figure,
        [
            *(Line2D([], [], color=colour, lw=1.6, label=f"{label}: median, 10 to 90 %") for _, colour, label in runs),
            Line2D([], [], color=drawing.SETPOINT, lw=1.2, ls="--", label="setpoint"),
            Patch(fc="none", ec=drawing.LIMIT, hatch="////", lw=0, label="beyond the limits"),
        ],
    )
    return figure


def save(figure: Figure, path: str | Path, dpi: int = 110) -> Path:
    """Write ``figure`` to ``path`` (.png or .svg), making its folder; returns the path.

    Raises
    ------
    InvalidArgumentError
        Another suffix.
    """
    path = check_path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix.lower() == ".svg":
        figure.savefig(path, dpi=dpi)
        return path
    figure.set_dpi(dpi)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    image = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    # A palette of 256 colours cannot be told from the original, and takes a third of the bytes.
    image.quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(path, optimize=True, dpi=(dpi, dpi))
    return path


def check_path(path: str | Path) -> Path:
    """``path`` if its suffix is one that :func:`save` can write; see there."""
    path = Path(path)
    if path.suffix.lower() not in FORMATS:
        raise InvalidArgumentError(
            "path", "unknown picture format", value=str(path), remedy=f"end it in {' or '.join(FORMATS)}"
        )
    return path


# -- layout ------------------------------------------------------------------------------------------------------


def _figure(
    traces: Traces, joints: Sequence[int | str] | None, *, rows: int, title: str
) -> tuple[Figure, Iterator[tuple[int, list[Axes]]]]:
    """A figure with one block of ``rows`` panels for each joint, in a grid; and (joint, panels) pairs."""
    chosen = traces.chosen(joints)
    # As few empty places as can be, in three columns, or four or five of many joints.
    columns = min(len(chosen), 3) if len(chosen) <= 9 else min((4, 5), key=lambda n: -len(chosen) % n)
    lines = math.ceil(len(chosen) / columns)
    heights = (1.7, 0.85)[:rows]
    between = 0.06  # a thin empty row sets one joint's panels apart from the next one's
    size = ((4.0 if columns < 5 else 3.6) * columns, (sum(heights) + between) * lines + 0.75)
    figure = Figure(figsize=size, layout="constrained")
    figure.get_layout_engine().set(h_pad=0.02, w_pad=0.05, hspace=0.0)  # type: ignore[call-arg, union-attr]
    if title:
        figure.suptitle(title, fontsize=11)
    # One flat grid, so that the panels of a column are aligned.
    grid = figure.add_gridspec(lines * (rows + 1), columns, height_ratios=(*heights, between) * lines)

    def blocks() -> Iterator[tuple[int, list[Axes]]]:
        for place, joint in enumerate(chosen):
            line, column = divmod(place, columns)
            block = [figure.add_subplot(grid[line * (rows + 1) + row, column]) for row in range(rows)]
            last = place + columns >= len(chosen)
            for axes in block:
                axes.tick_params(labelsize=drawing.SMALL, length=2)
                axes.spines[["top", "right"]].set_visible(False)
                axes.set_xlim(0, traces.time[-1])
                axes.yaxis.set_major_locator(MaxNLocator(4))
                axes.tick_params(labelbottom=axes is block[-1] and last)
            if last:
                block[-1].set_xlabel("time [s]", fontsize=drawing.SMALL)
            yield joint, block

    return figure, blocks()


def _name(axes: Axes, traces: Traces, joint: int) -> None:
    axes.set_title(traces.joint_names[joint], fontsize=8, loc="left", pad=3, fontweight="bold")


def _legend(figure: Figure, handles: list[Any]) -> None:
    # As many side by side as the figure is wide enough for: an entry of n letters takes about n + 8 of them.
    letters = figure.get_figwidth() * 17
    columns = max(1, min(len(handles), int(letters / (8 + max(len(handle.get_label()) for handle in handles)))))
    if sum(len(handle.get_label()) + 8 for handle in handles) < letters:
        columns = len(handles)
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, fontsize=7.5, frameon=False)
