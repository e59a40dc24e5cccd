"""Gains: their design, and the stability of the loop under them."""

from batchpid.gains.design import design_gains, pid_from_inertia
from batchpid.gains.stability import stability_bound

__all__ = ["design_gains", "pid_from_inertia", "stability_bound"]
