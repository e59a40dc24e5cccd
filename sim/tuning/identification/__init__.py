"""Identification of a robot's actuators from logs: motion to record, logs, regression, fit and report."""
