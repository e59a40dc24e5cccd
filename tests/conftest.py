"""Settings of every test."""

import signal

from hypothesis import HealthCheck, settings

# No deadline: the time of an example depends on the load of the machine.
settings.register_profile("patient", settings.default, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("patient")

# A background job of a script ignores SIGINT, and so would the programs that the tests start.
signal.signal(signal.SIGINT, signal.default_int_handler)
