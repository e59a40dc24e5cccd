"""Randomization of the robots: distributions, and what is drawn from them for each env and episode."""
