"""Cost of candidates, with the same terms for gains of joints and for gains of a tool.

The cost of a move is the mean, over its joints or the axes of a tool, of the following sum. The cost of a candidate is
the mean over its moves, plus the cost of its worst move::

    w_itae log(1 + ITAE / (A 1 s^2)) + w_settling Ts / 1 s + w_overshoot log(1 + O / 5 %) + w_final log(1 + E / b)
        + w_chatter log(1 + max(TV / TV_smooth - 1, 0)) + w_saturation S

plus the mean over moves of w_late log(1 + max(Ts / Tmax - 1, 0) / 5 %) for the figure that settles last.

Ts is limited to 1.5 times the run; Tmax is the settling time asked for. A is the move, or the smallest move that
counts; O the overshoot as a fraction of A; E the final error, and b the least half width of the settling band; TV the
total variation of the effort, and TV_smooth its variation in the smooth motion that takes a second; S the share of time
in saturation. The logarithms prevent a single move or joint from deciding.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Float64
from batchpid.checks.validate import number
from batchpid.metrics import StepMetrics
from batchpid.sim.observation import Rollout

HEADROOM = 0.9
"""Share of the effort limits that candidates may use."""
DIVERGED_COST = 1e3
"""Cost of a candidate that diverges; up to twice as much if it diverges early."""
PENALTY_RATIO = 0.8
"""Stability ratio (:func:`batchpid.stability_bound`) beyond which a candidate is penalised."""


@dataclass(frozen=True)
class Weights:
    """Weights of the terms of the cost; the command line has a flag for each."""

    itae: float = 1.0
    """Weight of the normalised ITAE, the time-weighted absolute error."""
    settling: float = 1.0
    """Weight of the settling time [1/s]."""
    overshoot: float = 1.0
    """Weight of log(1 + overshoot / 5 %): one move out of reach must not outweigh all others."""
    late: float = 4.0
    """Weight of log(1 + excess of the settling time over the time asked for / 5 %), of a move's last joint."""
    final: float = 2.0
    """Weight of log(1 + final error / least half width of the settling band)."""
    chatter: float = 0.3
    """Weight of log(variation of the effort / variation in the smooth move), if that is positive."""
    saturation: float = 3.0
    """Weight of the share of time for which the effort is saturated."""
    following: float = 1.0
    """Weight of log(1 + following error / 10 times the least half width of the settling band), where moves are smooth
    motions of the setpoint; 0: steps alone. Gains of a tool are searched on steps alone."""

    def __post_init__(self) -> None:
        for each in fields(self):
            number(each.name, getattr(self, each.name), 0.0, 1e6, "weight")


class Trial(NamedTuple):
    """Candidates that were run on their moves."""

    costs: tuple[float, ...]
    """Cost of each candidate."""
    metrics: StepMetrics
    """Metrics of the moves that are steps of the setpoint (candidates, moves, joints or axes)."""
    rollout: Rollout


def bounded(figure: Float64) -> Float64:
    """Return ``figure``, limited to 1e6: simulations may diverge."""
    return np.minimum(figure, 1e6)


def response_cost(w: Weights, m: StepMetrics, size: Float64, band: Float64) -> Float64:
    """Return the terms of the cost for the response, entry by entry, of bounded metrics ``m``."""
    cost: Float64 = (
        w.itae * np.log1p(m.itae / size)
        + w.settling * m.settling_time
        + w.overshoot * np.log1p(m.peak_deviation / size / 0.05)
        + w.final * np.log1p(m.steady_state_error / band)
    )
    return cost


def chatter(variation: Float64, smooth: Float64) -> Float64:
    """Return log(1 + max(TV / TV_smooth - 1, 0)) of the bounded variations TV and TV_smooth of the effort."""
    excess: Float64 = np.log1p(np.maximum(variation / smooth - 1, 0))
    return excess


def over_moves(cost: Float64, worst_counts: bool = True) -> Float64:
    """Return the mean of ``cost`` (count, moves) over moves plus its largest, or twice the mean: (count,)."""
    total: Float64 = cost.mean(1) + (cost.max(1) if worst_counts else cost.mean(1))
    return total


def late(settling: Float64, limit: Float64 | float) -> Float64:
    """Return the mean over moves of log(1 + max(Ts / Tmax - 1, 0) / 5 %), for ``settling`` (count, moves): (count,)."""
    excess: Float64 = np.log1p(np.maximum(settling / limit - 1, 0) / 0.05).mean(1)
    return excess


def with_divergence(total: Float64, ok: NDArray[np.bool_]) -> Float64:
    """Return costs (count,), at most DIVERGED_COST; candidates with a diverged env cost more, up to twice that.

    ``ok`` (ticks, envs) is True until an env diverges.
    """
    lasted = ok.mean(0).reshape(len(total), -1)
    return np.where(lasted.min(1) < 1, DIVERGED_COST * (2 - lasted.mean(1)), np.minimum(total, DIVERGED_COST))
