"""Diagnosis of runs."""
