"""What holds for every test."""

import signal

from hypothesis import HealthCheck, settings

# How long an example takes tells how busy the machine is, and nothing about the code.
settings.register_profile("patient", settings.default, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("patient")

# Where tests run in the background of a script, Ctrl-C comes ignored, and so it would for the programs they start.
signal.signal(signal.SIGINT, signal.default_int_handler)
