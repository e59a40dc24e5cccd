"""Joint-level PID control for many robots at once: arrays in, arrays out."""

from batchpid.controller import BatchPID
from batchpid.errors import BatchPIDError, InvalidArgumentError, MissingDependencyError
from batchpid.law import PIDState, Terms, advance, discretise, init, reset, step, track
from batchpid.params import PIDParams, make_params

__all__ = [
    "BatchPID",
    "BatchPIDError",
    "InvalidArgumentError",
    "MissingDependencyError",
    "PIDParams",
    "PIDState",
    "Terms",
    "advance",
    "discretise",
    "init",
    "make_params",
    "reset",
    "step",
    "track",
]
