"""Rollouts in files, and as labelled data."""
