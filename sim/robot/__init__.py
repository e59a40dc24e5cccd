"""Robot descriptions, from a URDF to a checked :class:`sim.Robot`, without SAPIEN."""
