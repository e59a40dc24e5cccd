"""Figures of runs, drawn by Matplotlib."""

from batchpid.sim.plots.figures import (
    FORMATS,
    save,
    step_responses,
)

__all__ = [
    "FORMATS",
    "save",
    "step_responses",
]
