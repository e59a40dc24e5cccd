"""Python calls of the calling process in one tick."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from robots import load_bundled

from batchpid.sim import Runner

PANDA = load_bundled("panda")
CALLS, LEVELS = 20, 6


def python_calls(act):
    """Return the number of Python calls of ``act`` in this thread, itself not counted, and the
    deepest level.
    """
    depths, level = [], 0

    def on_event(frame, event, argument):
        nonlocal level
        if event == "call":
            depths.append(level)
            level += 1
        elif event == "return":
            level -= 1

    sys.setprofile(on_event)
    try:
        act()
    finally:
        sys.setprofile(None)
    return len(depths) - 1, max(depths)


def test_calls_are_counted():
    assert (
        python_calls(lambda: np.median(np.zeros(3)))[0]
        > python_calls(lambda: pytest.approx)[0]
        == 0
    )


@pytest.mark.parametrize(("shape", "more"), [((64, PANDA.dof), 0), ((PANDA.dof,), 1)])
def test_python_calls_of_a_tick(shape, more):
    setpoint = np.broadcast_to(PANDA.settings.target, shape).copy()
    with Runner(PANDA, 64, workers=1, substeps=2) as runner:
        for _ in range(2):
            runner.step(setpoint)
        for _ in range(100):  # on a busy machine many
            count, levels = python_calls(lambda: runner.step(setpoint))
            if count <= CALLS + more:
                break
    assert 10 < count <= CALLS + more
    assert 3 < levels <= LEVELS
