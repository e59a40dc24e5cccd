"""Figure of an identification: position errors before and after."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from batchpid.arrays.array_types import Float64
from batchpid.sim.plots import drawing
from batchpid.sim.plots.figures import Picture


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


def fit_errors(fits: Sequence[FitErrors], names: Sequence[str], units: Sequence[str], title: str) -> Figure:
    """Draw the position errors of the joints ``names`` along the stretches of one log, before and after.

    The part that was kept to judge is shaded.
    """
    columns = min(3, len(names))
    rows = math.ceil(len(names) / columns)
    figure = Picture(figsize=(4.2 * columns, 0.8 + 2.0 * rows), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False, sharex=True)
    kept = [fit.time[~fit.fitted] for fit in fits]
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
                    fit.time[::every], error[::every], color=colour, lw=0.8, label=label if index == 0 else None
                )
        for times in kept:
            if len(times):
                axes.axvspan(times[0], times[-1], color=drawing.SETPOINT, alpha=0.15, lw=0)
        axes.set_title(names[number], fontsize=drawing.SMALL)
        axes.set_ylabel(units[number], fontsize=drawing.SMALL)
    figure.supxlabel("time [s]", fontsize=drawing.SMALL)
    figure.suptitle(title, fontsize=drawing.SMALL + 2)
    grid.flat[0].legend(fontsize=drawing.SMALL)
    return figure
