"""Settings of every test, and fixtures of tests in several folders."""

import signal
from collections.abc import Iterator

import pytest
from hypothesis import HealthCheck, settings

# No deadline: the time of an example depends on the load of the machine.
settings.register_profile("patient", settings.default, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("patient")

# A background job of a script ignores SIGINT, and so would the programs that the tests start.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures are not drawn: that takes longer than the robots."""
    for name in ("step_responses", "comparison", "fit_errors"):
        monkeypatch.setattr(f"batchpid.sim.plots.{name}", lambda *_, **__: None)
    monkeypatch.setattr("batchpid.sim.plots.save", lambda _, path: path)


@pytest.fixture
def quick_compilation() -> Iterator[None]:
    """Let JAX compile with few optimisations."""
    jax = pytest.importorskip("jax")
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)
    jax.clear_caches()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give each slow test hours: its limit is there to end one that hangs, also on a machine that is busy."""
    for item in items:
        if item.get_closest_marker("slow") is not None:
            item.add_marker(pytest.mark.timeout(4 * 3600), append=False)
