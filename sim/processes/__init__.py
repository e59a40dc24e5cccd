"""A thread for calls that no signal may interrupt. Knows nothing of robots."""
