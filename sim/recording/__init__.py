"""Rollouts in files, and as labelled data."""

from batchpid.sim.recording.dataset import open_dataset, to_dataset

__all__ = ["open_dataset", "to_dataset"]
