"""Randomization of the robots: distributions, and the values drawn from them for each env and
episode.
"""
