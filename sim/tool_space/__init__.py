"""Operational-space control of a tool in the Runner."""
