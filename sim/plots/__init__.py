"""Figures of runs, drawn by Matplotlib."""

from batchpid.sim.plots.figures import (
    FORMATS,
    FitErrors,
    comparison,
    efforts,
    fit_errors,
    following_errors,
    save,
    step_responses,
)

__all__ = [
    "FORMATS",
    "FitErrors",
    "comparison",
    "efforts",
    "fit_errors",
    "following_errors",
    "save",
    "step_responses",
]
