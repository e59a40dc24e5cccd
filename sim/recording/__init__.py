"""Rollouts in HDF5 files, and setpoints in CSV files."""
