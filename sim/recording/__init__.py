"""Rollouts in HDF5 files."""
