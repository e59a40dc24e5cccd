"""Figures of runs, drawn by Matplotlib."""

from batchpid.sim.plots.figures import (
    FORMATS,
    comparison,
    efforts,
    following_errors,
    save,
    step_responses,
)

__all__ = [
    "FORMATS",
    "comparison",
    "efforts",
    "following_errors",
    "save",
    "step_responses",
]
