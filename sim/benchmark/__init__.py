"""Speed and accuracy of the runner, against baselines: ``batchpid bench``."""
