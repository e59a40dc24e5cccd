"""Gains by simulation: the search for them, and the comparison of sets of gains."""

from batchpid.sim.tuning.evaluation import Comparison, compare
from batchpid.sim.tuning.search import Tuning, tune

__all__ = ["Comparison", "Tuning", "compare", "tune"]
