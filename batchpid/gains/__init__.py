"""Gains: their design, the stability of the loop under them, presets."""
