"""Joint-level PID control for many robots at once: arrays in, arrays out."""

from batchpid.coefficients import Coefficients, discretise
from batchpid.controller import BatchPID
from batchpid.errors import BatchPIDError, InvalidArgumentError, MissingDependencyError
from batchpid.law import advance, init, reset, step, track
from batchpid.params import PIDParams, make_params
from batchpid.state import PIDState, Terms

__all__ = [
    "BatchPID",
    "BatchPIDError",
    "Coefficients",
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
