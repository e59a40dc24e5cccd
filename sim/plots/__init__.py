"""Figures of runs, drawn by Matplotlib."""

from batchpid.sim.plots.figures import FORMATS, comparison, efforts, save, step_responses
from batchpid.sim.plots.fits import FitErrors, fit_errors

__all__ = ["FORMATS", "FitErrors", "comparison", "efforts", "fit_errors", "save", "step_responses"]
