"""Robot descriptions, from a URDF to a checked :class:`batchpid.sim.Robot`, without SAPIEN."""
