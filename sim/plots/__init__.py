"""Figures of runs, drawn by Matplotlib."""

from batchpid.sim.plots.figures import (
    FORMATS,
    fit_errors,
    save,
    step_responses,
)

__all__ = [
    "FORMATS",
    "fit_errors",
    "save",
    "step_responses",
]
