"""Joint-level PID control for many robots at once: arrays in, arrays out."""

from batchpid import presets
from batchpid.bumpless import track
from batchpid.coefficients import Coefficients, discretise
from batchpid.controller import BatchPID
from batchpid.design import design_gains
from batchpid.drive import drive_target
from batchpid.errors import BatchPIDError, InvalidArgumentError, MissingDependencyError
from batchpid.law import advance, init, reset, step
from batchpid.params import PIDParams, make_params
from batchpid.serialization import dumps_params, load_about, load_params, loads_params, save_params
from batchpid.stability import spectral_radius, stability_bound
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
    "design_gains",
    "discretise",
    "drive_target",
    "dumps_params",
    "init",
    "load_about",
    "load_params",
    "loads_params",
    "make_params",
    "presets",
    "reset",
    "save_params",
    "spectral_radius",
    "stability_bound",
    "step",
    "track",
]
