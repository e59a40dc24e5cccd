"""Settings of every test, and fixtures of tests in several folders."""

import signal

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

# No deadline: the time of an example depends on the load of the machine.
settings.register_profile(
    "patient", settings.default, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("patient")

# A background job of a script ignores SIGINT, and so would the programs that the tests start.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture
def undrawn(monkeypatch):
    """Pictures are not drawn: that takes longer than the robots."""
    monkeypatch.setattr("batchpid.sim.plots.step_responses", lambda *_, **__: None)
    monkeypatch.setattr("batchpid.sim.plots.save", lambda _, path: path)


@pytest.fixture
def quick_compilation():
    """Make JAX compile with few optimisations."""
    jax = pytest.importorskip("jax")
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)
    jax.clear_caches()


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Make most rows of tests with ``quick_rows`` slow, and give each slow test hours, to end only
    one that hangs.
    """
    rows = {}
    for item in items:
        if (quick := item.get_closest_marker("quick_rows")) is not None and item.get_closest_marker(
            "slow"
        ) is None:
            rows.setdefault((item.nodeid.partition("[")[0], quick.args[0]), []).append(item)
    for (_, count), found in rows.items():
        kept = {round(place) for place in np.linspace(0, len(found) - 1, count)}
        for number, item in enumerate(found):
            if number not in kept:
                item.add_marker(pytest.mark.slow)
    for item in items:
        if item.get_closest_marker("slow") is not None:
            item.add_marker(pytest.mark.timeout(4 * 3600), append=False)
