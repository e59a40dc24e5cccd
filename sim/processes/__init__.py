"""Start of child processes, and a thread for calls that no signal may interrupt. Knows nothing of robots."""
