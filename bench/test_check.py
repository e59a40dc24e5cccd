"""Performance checks: ratios of speeds that must not fall below their floors. ``make bench-check`` runs them.

A ratio compares two ways of stepping the same robots in one run, so it depends little on the machine; a run is repeated
before a check fails, because something else may have used the cores. To compare absolute times with an earlier run of
the same machine, use pytest-benchmark's ``--benchmark-save`` and ``--benchmark-compare-fail`` (docs/performance.md).
"""

from __future__ import annotations

import pytest

from sim import Robot
from sim.benchmark.benchmark import Result, measure_rates
from sim.benchmark.workload import Workload
from sim.engine import native

ATTEMPTS = 3
FLOORS = {
    # closed loop over: floor (accurate, fast), about a tenth below what is measured on an idle machine
    "bare engine, pack by pack": (0.76, 0.68),  # control, compensation and calls may take a quarter, a third at "fast"
    "tutorial": (2.4, 3.4),  # what a user of SAPIEN's tutorial gains on 2 cores
    "closed loop, Python calls": (1.0, 1.05),  # what the extension is built for
    "closed loop, tick by tick": (0.95, 0.95),  # a rollout is never slower than its ticks one by one
}


@pytest.mark.check
@pytest.mark.parametrize("physics", ["accurate", "fast"])
@pytest.mark.parametrize("name", ["panda", "jaco2"])
def test_ratios_keep_their_floors(name, physics):
    floors = {over: both[physics == "fast"] for over, both in FLOORS.items()}
    if not native.status().active:
        del floors["closed loop, Python calls"]
    for _ in range(ATTEMPTS):
        results = measure_rates(Workload(Robot.load(name), physics=physics, rounds=3))
        found = {over: ratio(results["closed loop"], results[over]) for over in floors}
        short = {over: value for over, value in found.items() if value < floors[over]}
        print(f"\n{name}, {physics}: " + ", ".join(f"{value:.2f} of {over!r}" for over, value in found.items()))
        if not short:
            return
    pytest.fail(f"closed loop over other cases: {short}, floors {floors}, in {ATTEMPTS} runs")


def ratio(ours: Result, theirs: Result) -> float:
    """Return the median over the rounds, which are paired, of our rate over theirs."""
    ratios = sorted(first / second for first, second in zip(ours.rates, theirs.rates, strict=True))
    return ratios[len(ratios) // 2]
