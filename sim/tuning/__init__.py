"""Gains: the moves to judge them by, their evaluation, the search."""
