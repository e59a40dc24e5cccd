"""Gains by simulation: moves to evaluate them on, their evaluation, and the search for them."""

from batchpid.sim.tuning.candidates import Weights
from batchpid.sim.tuning.comparison import Comparison, GainSet, compare, gain_set
from batchpid.sim.tuning.evaluation import (
    Evaluation,
    arm_joints,
    evaluate_gains,
    following_error,
    load_randomization,
    run_moves,
    step_response_metrics,
)
from batchpid.sim.tuning.moves import Moves, random_moves, tutorial_move
from batchpid.sim.tuning.search import Tuning, tune

__all__ = [
    "Comparison",
    "Evaluation",
    "GainSet",
    "Moves",
    "Tuning",
    "Weights",
    "arm_joints",
    "compare",
    "evaluate_gains",
    "following_error",
    "gain_set",
    "load_randomization",
    "random_moves",
    "run_moves",
    "step_response_metrics",
    "tune",
    "tutorial_move",
]
