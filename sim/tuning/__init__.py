"""Gains by simulation: moves to evaluate them on, their evaluation, and the search for them.

Names are loaded when they are first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from batchpid.sim.tuning.comparison import Comparison, compare
    from batchpid.sim.tuning.cost import Weights
    from batchpid.sim.tuning.evaluation import (
        Evaluation,
        arm_joints,
        evaluate_gains,
        following_error,
        run_moves,
        step_response_metrics,
        within,
    )
    from batchpid.sim.tuning.gain_sets import GainSet, gain_set
    from batchpid.sim.tuning.moves import Moves, random_moves, search_moves, tutorial_move
    from batchpid.sim.tuning.randomization_files import load_randomization
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
    "search_moves",
    "step_response_metrics",
    "tune",
    "tutorial_move",
    "within",
]

_MODULES = {
    "comparison": ("Comparison", "compare"),
    "cost": ("Weights",),
    "evaluation": (
        "Evaluation",
        "arm_joints",
        "evaluate_gains",
        "following_error",
        "run_moves",
        "step_response_metrics",
        "within",
    ),
    "gain_sets": ("GainSet", "gain_set"),
    "moves": ("Moves", "random_moves", "search_moves", "tutorial_move"),
    "randomization_files": ("load_randomization",),
    "search": ("Tuning", "tune"),
}
_HOMES = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'batchpid.sim.tuning' has no attribute {name!r}")
    return getattr(importlib.import_module(f"batchpid.sim.tuning.{_HOMES[name]}"), name)
