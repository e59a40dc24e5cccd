"""Figure of a comparison of two engines."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from batchpid.sim.plots import drawing

Float64 = NDArray[np.float64]


def engine_differences(
    time: Float64, open_loop: Float64, chaos: Float64, ticks: Float64, closed_loop: Float64, title: str
) -> Figure:
    """Draw differences of positions: under equal efforts, with rounding for comparison, and under gains on each move.

    Arrays are (times,), and ``closed_loop`` (ticks, moves) over ``ticks`` (ticks,) [s].
    """
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.semilogy(time, np.maximum(open_loop, 1e-9), color=drawing.ENV, lw=1.2, label="between the engines")
    left.semilogy(time, np.maximum(chaos, 1e-9), color=drawing.SECOND, lw=1.2, label="one bit apart, in SAPIEN")
    left.set_title("equal efforts", fontsize=drawing.SMALL + 1)
    left.legend(fontsize=drawing.SMALL)
    right.semilogy(ticks, np.maximum(closed_loop, 1e-9), color=drawing.ENV, lw=0.8)
    right.set_title("equal gains, each move", fontsize=drawing.SMALL + 1)
    for axes in (left, right):
        axes.set_xlabel("time [s]", fontsize=drawing.SMALL)
        axes.set_ylabel("largest difference [rad or m]", fontsize=drawing.SMALL)
    figure.suptitle(title, fontsize=drawing.SMALL + 2)
    return figure
