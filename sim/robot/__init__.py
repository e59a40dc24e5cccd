"""Robots: :class:`batchpid.sim.Robot`, what it is asked for, and its export to other programs."""
