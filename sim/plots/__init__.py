"""Figures of runs, drawn by Matplotlib."""

from sim.plots.figures import comparison, efforts, save, step_responses

__all__ = ["comparison", "efforts", "save", "step_responses"]
