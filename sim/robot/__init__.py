"""Robots: :class:`batchpid.sim.Robot`, its model, the options of its runs, and its exports."""
