"""Runner: N robots under one batch controller, and its requests."""
