"""Fits at a bound, on a problem of linear residuals: evaluations left, and the decrease that is still promised."""

from types import SimpleNamespace

import numpy as np
import pytest

from batchpid.sim.identification.fit import FitStep, fit
from batchpid.sim.identification.problem import FitEvaluation

TIME = np.linspace(0, 1, 8)
JACOBIAN = np.stack([np.ones(8), TIME], axis=-1)[:, None]


class Line:
    """Rows 5 + t - (offset + slope t), whose best offset lies beyond its bound of 1."""

    unknowns = SimpleNamespace(scale=np.ones(2), spread=1e3 * np.ones(2), low=-np.ones(2), high=np.ones(2), prior=0.0)
    stretches, count = [[np.arange(8)]], 8

    def evaluate(self, theta):
        rows = (5 + TIME - JACOBIAN[:, 0] @ theta)[:, None]
        return [FitEvaluation(rows, rows, JACOBIAN, np.zeros((1, 1)), np.ones_like(rows))]

    def sizes(self, white):
        return np.sqrt(np.mean(np.square(white), axis=1))

    def costs(self, sizes, determinants):
        return np.log(sizes)


@pytest.mark.parametrize("evaluations", range(1, 6))
def test_a_fit_at_a_bound_leaves_no_less_than_no_evaluation(evaluations):
    steps = []
    found = fit(Line(), FitStep.first(np.array([1.0, 0.0]), evaluations), lambda step, _: steps.append(step))
    assert len(steps) > 1
    assert min(step.left for step in steps) >= 0
    again = fit(Line(), steps[-1])  # as from a history
    assert (again.theta == found.theta).all()
    assert again.cost == found.cost


def test_what_a_bound_closes_promises_nothing():
    """A fit whose best point is at a bound has arrived: its unknowns count as found."""
    begun = fit(Line(), FitStep.first(np.zeros(2), 0))
    assert begun.promised > 0.03
    arrived = fit(Line(), FitStep.first(np.zeros(2), 40))
    assert arrived.theta == pytest.approx([1.0, 1.0], abs=1e-3)
    assert arrived.promised < 0.003
