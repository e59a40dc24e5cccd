"""Weights of the cost of gains, whose terms are in :mod:`batchpid.sim.tuning.candidates`."""

from __future__ import annotations

from dataclasses import dataclass, fields

from batchpid.checks.validate import number


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
    """Weight of log(1 + excess of the settling time over the time asked for / 5 %), of a move's
    last joint.
    """
    final: float = 2.0
    """Weight of log(1 + final error / least half width of the settling band)."""
    chatter: float = 0.3
    """Weight of log(variation of the effort / variation in the smooth move), if that is
    positive.
    """
    saturation: float = 3.0
    """Weight of the share of time for which the effort is saturated."""
    following: float = 1.0
    """Weight of log(1 + following error / 10 times the least half width of the settling band),
    where moves are smooth motions of the setpoint; 0: steps alone.
    """

    def __post_init__(self) -> None:
        for entry in fields(self):
            number(entry.name, getattr(self, entry.name), 0.0, 1e6, "weight")
