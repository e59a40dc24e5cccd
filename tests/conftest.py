"""What holds for every test."""

import signal

# Where tests run in the background of a script, Ctrl-C comes ignored, and so it would for the programs they start.
signal.signal(signal.SIGINT, signal.default_int_handler)
