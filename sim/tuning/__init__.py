"""Gains: moves to evaluate them on, their evaluation, and the search for them."""
