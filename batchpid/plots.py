"""Pictures of a run: step responses, efforts against their limits, and two runs side by side.

Everything is drawn by Matplotlib's object interface on the Agg and SVG canvases: no display, no global state.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from batchpid.errors import InvalidArgumentError

FORMATS = (".png", ".svg")
ENV, MEDIAN, SECOND, SETPOINT, LIMIT, MARKED = (
    "#4c78a8",
    "#16324f",
    "#e45756",
    "#2f8f4e",
    "#b23a48",
    "#f28e2b",
)
_SMALL = 7.0


@dataclass(frozen=True, eq=False)
class Traces:
    """What there is to draw of a run. Limits that a joint does not have are infinite.

    Not-finite samples are gaps; so is everything of an env from where ``ok`` is False.
    """

    time: NDArray[Any]
    """(ticks,) [s]."""
    setpoint: NDArray[Any]
    """(ticks, envs, joints) [rad or m]."""
    qpos: NDArray[Any]
    """(ticks, envs, joints) [rad or m]."""
    effort: NDArray[Any]
    """(ticks, envs, joints) [N m or N]."""
    saturated: NDArray[Any]
    """(ticks, envs, joints) bool."""
    joint_names: tuple[str, ...]
    units: tuple[str, ...]
    """Of each joint's position: "rad" or "m"."""
    lower: NDArray[Any]
    """(joints,) [rad or m]."""
    upper: NDArray[Any]
    """(joints,) [rad or m]."""
    effort_limit: NDArray[Any]
    """(joints,) [N m or N]."""
    label: str = ""

    @classmethod
    def of(cls, rollout: Any, robot: Any, label: str = "") -> Traces:
        """Traces of a ``sim.Rollout`` of a ``sim.Robot`` (or of anything with these attributes)."""
        alive = np.asarray(rollout.ok)[..., None]
        return cls(
            time=np.asarray(rollout.time),
            setpoint=np.asarray(rollout.setpoint),
            qpos=np.where(alive, rollout.qpos, np.nan),
            effort=np.where(alive, rollout.effort, np.nan),
            saturated=np.asarray(rollout.saturated),
            joint_names=tuple(robot.joint_names),
            units=tuple(joint.unit for joint in robot.joints),
            lower=np.asarray(robot.lower),
            upper=np.asarray(robot.upper),
            effort_limit=np.asarray(robot.effort_limit),
            label=label,
        )

    @property
    def num_envs(self) -> int:
        """Number of envs."""
        return int(self.qpos.shape[1])

    def effort_unit(self, joint: int) -> str:
        """Unit of a joint's effort."""
        return "N" if self.units[joint] == "m" else "N m"

    def chosen(self, joints: Sequence[int | str] | None) -> list[int]:
        """Indices of ``joints`` given by index or name; None: all."""
        if joints is None:
            return list(range(len(self.joint_names)))
        known: dict[int | str, int] = {name: index for index, name in enumerate(self.joint_names)}
        known |= {index: index for index in range(len(self.joint_names))}
        for joint in joints:
            if joint not in known:
                raise InvalidArgumentError(
                    "joints", "no such joint", value=joint, remedy=f"use {', '.join(self.joint_names)}"
                )
        return [known[joint] for joint in joints]


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
    figure, panels = _figure(traces, joints, rows=2, title=title)
    for joint, (above, below) in panels:
        _name(above, traces, joint)
        _draw_limits(above, traces.lower[joint], traces.upper[joint])
        _draw_setpoint(above, traces, joint, band)
        _draw_fan(above, traces.time, traces.qpos[..., joint], mark)
        _view(above, np.stack([traces.qpos[..., joint], traces.setpoint[..., joint]]), traces, joint)
        _draw_efforts(below, traces, joint, mark)
    median = Line2D([], [], color=MEDIAN, lw=1.6, label="median")
    _legend(
        figure,
        [
            Line2D([], [], color=ENV, alpha=0.6, lw=0.8, label=f"each of {traces.num_envs} envs"),
            *([] if mark is None else [Line2D([], [], color=MARKED, lw=1.2, label=f"env {mark}")]),
            median,
            Line2D([], [], color=SETPOINT, lw=1.2, ls="--", label="setpoint"),
            Patch(color=SETPOINT, alpha=0.2, lw=0, label=f"settling band, {band:.0%} of the move"),
            Patch(fc="none", ec=LIMIT, hatch="////", lw=0, label="beyond the limits"),
            Patch(color=LIMIT, alpha=0.6, lw=0, label="share of envs in saturation"),
        ],
    )
    return figure


def efforts(
    traces: Traces, *, joints: Sequence[int | str] | None = None, mark: int | None = None, title: str = ""
) -> Figure:
    """For each joint, efforts against their limit, and the share of envs in saturation."""
    figure, panels = _figure(traces, joints, rows=1, title=title)
    for joint, (axes,) in panels:
        _name(axes, traces, joint)
        _draw_efforts(axes, traces, joint, mark)
    _legend(
        figure,
        [
            Line2D([], [], color=ENV, alpha=0.6, lw=0.8, label=f"each of {traces.num_envs} envs"),
            Line2D([], [], color=MEDIAN, lw=1.6, label="median"),
            Line2D([], [], color=LIMIT, lw=1.0, label="limit"),
            Patch(color=LIMIT, alpha=0.6, lw=0, label="share of envs in saturation"),
        ],
    )
    return figure


def comparison(
    first: Traces, second: Traces, *, joints: Sequence[int | str] | None = None, title: str = ""
) -> Figure:
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
    runs = ((first, ENV, first.label or "first"), (second, SECOND, second.label or "second"))
    figure, panels = _figure(first, joints, rows=2, title=title)
    for joint, (above, below) in panels:
        _name(above, first, joint)
        _draw_limits(above, first.lower[joint], first.upper[joint])
        _draw_setpoint(above, first, joint, None)
        _draw_limits(below, -first.effort_limit[joint], first.effort_limit[joint])
        for run, colour, _ in runs:
            _draw_band(above, run.time, run.qpos[..., joint], colour)
            _draw_band(below, run.time, run.effort[..., joint], colour)
        both = [run.qpos[..., joint].ravel() for run, _, _ in runs]
        _view(above, np.concatenate([*both, first.setpoint[..., joint].ravel()]), first, joint)
        _view_efforts(
            below, np.concatenate([run.effort[..., joint].ravel() for run, _, _ in runs]), first, joint
        )
        for axes in (above, below):
            axes.set_xlim(0, max(first.time[-1], second.time[-1]))
    _legend(
        figure,
        [
            *(
                Line2D([], [], color=colour, lw=1.6, label=f"{label}: median, 10 to 90 %")
                for _, colour, label in runs
            ),
            Line2D([], [], color=SETPOINT, lw=1.2, ls="--", label="setpoint"),
            Patch(fc="none", ec=LIMIT, hatch="////", lw=0, label="beyond the limits"),
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
    image.quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(
        path, optimize=True, dpi=(dpi, dpi)
    )
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
    size = ((4.0 if columns < 5 else 3.6) * columns, sum(heights) * lines + 0.75)
    figure = Figure(figsize=size, layout="constrained")
    figure.get_layout_engine().set(h_pad=0.02, w_pad=0.05, hspace=0.0)  # type: ignore[call-arg, union-attr]
    if title:
        figure.suptitle(title, fontsize=11)
    # One flat grid, so that the panels of a column are aligned.
    grid = figure.add_gridspec(lines * rows, columns, height_ratios=heights * lines)

    def panels() -> Iterator[tuple[int, list[Axes]]]:
        for place, joint in enumerate(chosen):
            line, column = divmod(place, columns)
            block = [figure.add_subplot(grid[line * rows + row, column]) for row in range(rows)]
            last = place + columns >= len(chosen)
            for axes in block:
                axes.tick_params(labelsize=_SMALL, length=2)
                axes.spines[["top", "right"]].set_visible(False)
                axes.set_xlim(0, traces.time[-1])
                axes.yaxis.set_major_locator(MaxNLocator(4))
                axes.tick_params(labelbottom=axes is block[-1] and last)
            if last:
                block[-1].set_xlabel("time [s]", fontsize=_SMALL)
            yield joint, block

    return figure, panels()


def _name(axes: Axes, traces: Traces, joint: int) -> None:
    axes.set_title(traces.joint_names[joint], fontsize=8, loc="left", pad=3, fontweight="bold")


def _legend(figure: Figure, handles: list[Any]) -> None:
    figure.legend(
        handles=handles, loc="outside lower center", ncols=len(handles), fontsize=7.5, frameon=False
    )


# -- what goes into a panel --------------------------------------------------------------------------------------


def _draw_fan(axes: Axes, time: NDArray[Any], values: NDArray[Any], mark: int | None) -> None:
    """Every env as a thin line, the median as a bold one, ``mark`` apart."""
    lines = np.empty((values.shape[1], len(time), 2))
    lines[..., 0], lines[..., 1] = time, values.T
    alpha = min(0.9, max(0.08, 12.0 / len(lines)))
    # As one bitmap: an SVG of 64 envs by 9 joints would hold half a million points.
    axes.add_collection(
        LineCollection(list(lines), colors=ENV, linewidths=0.6, alpha=alpha, rasterized=True), autolim=False
    )
    axes.plot(time, _quantile(values, 0.5), color=MEDIAN, lw=1.5)
    if mark is not None:
        axes.plot(time, values[:, mark], color=MARKED, lw=1.1)


def _draw_band(axes: Axes, time: NDArray[Any], values: NDArray[Any], colour: str) -> None:
    axes.fill_between(time, _quantile(values, 0.1), _quantile(values, 0.9), color=colour, alpha=0.2, lw=0)
    axes.plot(time, _quantile(values, 0.5), color=colour, lw=1.4)


def _draw_setpoint(axes: Axes, traces: Traces, joint: int, band: float | None) -> None:
    """The setpoint, one line where all envs share it; around its last value the settling band."""
    setpoint = traces.setpoint[..., joint]
    shared = (setpoint == setpoint[:, :1]).all()
    axes.plot(traces.time, setpoint[:, 0] if shared else setpoint, color=SETPOINT, lw=1.1, ls="--", zorder=3)
    move = np.abs(setpoint[-1] - traces.qpos[0, :, joint])
    if band is not None and shared and np.isfinite(move).any():
        half = band * float(np.nanmedian(move))
        axes.axhspan(setpoint[-1, 0] - half, setpoint[-1, 0] + half, color=SETPOINT, alpha=0.2, lw=0)


def _draw_limits(axes: Axes, low: float, high: float) -> None:
    """A line at each finite limit, and hatching beyond."""
    for limit, sign in ((low, -1), (high, 1)):
        if math.isfinite(limit):
            far = limit + sign * 1e3 * max(1.0, abs(limit))
            axes.axhspan(limit, far, fc="none", ec=LIMIT, alpha=0.25, hatch="////", lw=0, zorder=0)
            axes.axhline(limit, color=LIMIT, lw=0.9, zorder=2)


def _draw_efforts(axes: Axes, traces: Traces, joint: int, mark: int | None) -> None:
    values, limit = traces.effort[..., joint], float(traces.effort_limit[joint])
    _draw_limits(axes, -limit, limit)
    _draw_fan(axes, traces.time, values, mark)
    _view_efforts(axes, values, traces, joint)
    share = traces.saturated[..., joint].mean(1)
    if share.any():
        strip = axes.inset_axes((0, 0.97, 1, 0.06))
        strip.imshow(
            share[None], aspect="auto", cmap=_saturation_colours(), vmin=0, vmax=1, interpolation="nearest"
        )
        strip.set_axis_off()
    peak = np.max(np.abs(values), initial=0.0, where=np.isfinite(values))
    if math.isfinite(limit):
        note = f"peak {peak / limit:.0%} of ±{limit:g} {traces.effort_unit(joint)}"
    else:
        note = f"peak {peak:.3g} {traces.effort_unit(joint)}, no limit"
    axes.text(
        0.99, 0.09, note, transform=axes.transAxes, ha="right", va="bottom", fontsize=6.5, color="#444444"
    )


def _saturation_colours() -> Any:
    from matplotlib.colors import LinearSegmentedColormap, to_rgba

    return LinearSegmentedColormap.from_list("saturation", [to_rgba(LIMIT, 0.0), to_rgba(LIMIT, 0.9)])


# -- what part of the axis is shown ------------------------------------------------------------------------------


def _view(axes: Axes, values: NDArray[Any], traces: Traces, joint: int) -> None:
    """Show the positions, but of a run that flies off only a little beyond the limits (or two turns)."""
    setpoint = traces.setpoint[..., joint]
    low, high = traces.lower[joint], traces.upper[joint]
    turn = 4 * np.pi if traces.units[joint] == "rad" else 1.0
    low = low if math.isfinite(low) else setpoint.min() - turn
    high = high if math.isfinite(high) else setpoint.max() + turn
    room = 0.15 * (high - low)
    low, high = min(low - room, setpoint.min()), max(high + room, setpoint.max())
    _set_view(axes, np.clip(values[np.isfinite(values)], low, high))
    axes.set_ylabel(traces.units[joint], fontsize=_SMALL)


def _view_efforts(axes: Axes, values: NDArray[Any], traces: Traces, joint: int) -> None:
    """Show the efforts, and their limit too where it is not many times farther."""
    limit, finite = float(traces.effort_limit[joint]), values[np.isfinite(values)]
    peak = np.abs(finite).max(initial=0.0)
    reach = [limit, -limit] if math.isfinite(limit) and peak > 0.2 * limit else []
    _set_view(axes, np.append(finite, [0.0, *reach]))
    axes.set_ylabel(traces.effort_unit(joint), fontsize=_SMALL)


def _set_view(axes: Axes, values: NDArray[Any]) -> None:
    if values.size:
        low, high = float(values.min()), float(values.max())
        room = 0.08 * (high - low) or 0.05 * max(abs(high), 1e-3)
        axes.set_ylim(low - room, high + room)


def _quantile(values: ArrayLike, q: float) -> NDArray[Any]:
    """Quantile over envs (axis 1) of what is finite; NaN where nothing is."""
    table = np.sort(np.where(np.isfinite(values), values, np.nan), axis=1)  # NaN last
    count = np.isfinite(table).sum(1)
    place = q * np.maximum(count - 1, 0)
    low = np.floor(place).astype(int)
    high = np.minimum(low + 1, np.maximum(count - 1, 0))
    rows = np.arange(len(table))
    result = table[rows, low] + (place - low) * (table[rows, high] - table[rows, low])
    return np.where(count > 0, result, np.nan)
