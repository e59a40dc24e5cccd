"""Noise of a log's columns, found by its frequency: roughly known at the rows, unknown between them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from batchpid.arrays.array_types import Float64

CUTOFF = 60.0
"""Frequency [Hz] above which a measured signal counts as noise."""
DRAWS = 16
"""Number of draws of the unknown noise."""
_MOST = 4.0
"""Largest noise, over its standard deviation; larger deviations count as motion."""


class Noise(NamedTuple):
    """White noise of a table (steps, columns) on the grid of the sim steps."""

    values: Float64
    """Noise at the log's rows, 0 between them (steps, columns)."""
    errors: Float64
    """Draws of the true noise less ``values`` (draws, steps, columns)."""
    size: Float64
    """Standard deviations (columns,), 0 if the rows are too far apart to determine them."""


def split(time: Float64, table: Float64, grid: Float64, given: bool = False) -> tuple[Float64, Noise]:
    """Return the columns of a table without noise, filtered without phase lag, and their noise.

    Parameters
    ----------
    time
        Times of the rows (rows,) [s].
    table
        (rows, columns).
    grid
        Times at which both are returned (steps,) [s], equidistant.
    given
        True if the errors are errors of the sum of both, which is exact at the rows; False if they are errors of the
        noise, whose part below the cutoff counts as motion.
    """
    from scipy.interpolate import make_interp_spline

    timestep, period, columns = grid[1] - grid[0], float(np.median(np.diff(time))), table.shape[1]
    step = np.clip(np.rint((time - grid[0]) / timestep).astype(int), 0, len(grid) - 1)
    values = np.zeros((len(grid), columns))
    if (share := 1 - 2 * CUTOFF * period) < 0.5:
        between = np.stack([np.interp(grid, time, column) for column in table.T], axis=1)
        return between, Noise(values, np.zeros((0, *values.shape)), np.zeros(columns))
    slow = _smooth(make_interp_spline(time, table)(grid), timestep)
    found = table - slow[step]
    size = 1.4826 * np.median(np.abs(found), axis=0) / np.sqrt(share)  # jerks of the joint do not affect the median
    values[step] = np.clip(found, -_MOST * size, _MOST * size)
    jerks = np.stack([np.interp(grid, time, column) for column in (found - values[step]).T], axis=1)
    draws = size * np.random.default_rng(0).standard_normal((DRAWS, *values.shape))
    rows, at_rows = np.unique(step), np.zeros(len(grid), bool)
    at_rows[rows] = True
    taken = np.stack([_smooth(make_interp_spline(grid[rows], draw[rows])(grid), timestep) for draw in draws])
    known = at_rows[:, None]
    errors = np.where(known, 0.0, draws - taken) if given else np.where(known, taken, draws)
    return slow + jerks, Noise(values, errors if errors.any() else errors[:0], size)


def _smooth(table: Float64, timestep: float) -> Float64:
    from scipy.signal import butter, sosfiltfilt

    sections = butter(4, CUTOFF, fs=1 / timestep, output="sos")
    return sosfiltfilt(sections, table, axis=0, padlen=min(len(table) - 1, 1000))
