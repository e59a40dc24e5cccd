"""Robot descriptions: from a URDF to a checked :class:`Robot`. Pure Python and NumPy."""
