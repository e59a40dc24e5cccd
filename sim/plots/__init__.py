"""Figures of runs, drawn by Matplotlib."""

from sim.plots.figures import FORMATS, comparison, efforts, save, step_responses

__all__ = ["FORMATS", "comparison", "efforts", "save", "step_responses"]
