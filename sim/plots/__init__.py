"""Figures of runs, drawn by Matplotlib."""

from sim.plots.figures import check_path, comparison, efforts, save, step_responses
from sim.plots.traces import Traces

__all__ = ["Traces", "check_path", "comparison", "efforts", "save", "step_responses"]
