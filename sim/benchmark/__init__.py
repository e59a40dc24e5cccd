"""What ``batchpid bench`` measures, and the baselines beside it."""
