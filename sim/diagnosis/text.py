"""Text of reports: tables, figures of many envs, and causes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
from tabulate import tabulate

from batchpid.arrays.array_types import Rows
from batchpid.sim.findings import Finding

MOST_CAUSES = 3
"""Causes that a report lists."""


def table(rows: Sequence[Sequence[str]], headers: Sequence[str], align: str) -> str:
    """Return ``rows`` under ``headers`` as text; ``align`` has one letter per column, "l" or
    "r".
    """
    sides = tuple("left" if side == "l" else "right" for side in align)
    return tabulate(rows, headers, disable_numparse=True, colalign=sides)


def cause_lines(findings: Sequence[Finding]) -> Iterator[str]:
    """Yield a line for each of the first causes, the most likely first."""
    for cause in findings[:MOST_CAUSES]:
        yield f"WHY: {cause.where}: {cause.text} ({cause.figures}); {cause.remedy}."
    if len(findings) > MOST_CAUSES:
        yield f"and {len(findings) - MOST_CAUSES} more, which rollout.findings() lists."


def overshoot_of_settled(overshoot: Rows, settling: Rows) -> Rows:
    """Return the overshoots of joints that settled; NaN for the others, of which it says
    nothing.
    """
    return np.where(np.isinf(settling) & np.isfinite(overshoot), np.nan, overshoot)


def median_and_worst(figures: Rows, style: str) -> str:
    """Return the median and the worst of ``figures``, "never" for infinity, and "-" where none is
    defined.
    """
    if np.isnan(figures).all():
        return "-"
    # Infinite figures allow no interpolation between two of them.
    quantiles = np.nanquantile(figures, [0.5, 1.0], method="higher")
    return " / ".join("never" if math.isinf(value) else style.format(value) for value in quantiles)
