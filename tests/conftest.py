"""Settings of every test."""

import signal

import pytest
from hypothesis import HealthCheck, settings

# No deadline: the time of an example depends on the load of the machine.
settings.register_profile("patient", settings.default, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("patient")

# A background job of a script ignores SIGINT, and so would the programs that the tests start.
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give each slow test hours: its limit is there to end one that hangs, also on a machine that is busy."""
    for item in items:
        if item.get_closest_marker("slow") is not None:
            item.add_marker(pytest.mark.timeout(4 * 3600), append=False)
