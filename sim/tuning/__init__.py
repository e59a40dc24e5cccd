"""Gains by simulation: moves to evaluate them on, their evaluation, and the search for them."""
