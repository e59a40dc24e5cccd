"""Joint-level PID control for many robots at once: arrays in, arrays out.

Params say how to control, a state is carried from step to step, and every array is (envs, joints)::

    import batchpid as bp
    import numpy as np

    params = bp.make_params(joints=9, kp=40, ki=5, kd=2, effort_limit=87, anti_windup="conditional")
    pid = bp.BatchPID(params, num_envs=64, dt=1 / 2000)  # keeps the state; or backend="jax"
    effort = pid(np.ones((64, 9)), np.zeros((64, 9)))  # setpoint, measurement

- Control: :class:`BatchPID`, or the pure functions :func:`init`, :func:`step`, :func:`reset` and
  :func:`track`, which take and return a :class:`PIDState`; :func:`discretise` and :func:`advance`
  for loops with constant params, and for all terms of the effort.
- Params: :func:`make_params`, ``params.replace(...)``; :func:`save_params`, :func:`load_params`,
  :func:`dumps_params`, :func:`loads_params`.
- Gains: :func:`design_gains` from a robot's inertia; :func:`stability_bound`.
- Limits of setpoints: :func:`make_guard` and :mod:`batchpid.motors.guard`.
- Chunks of a slow policy: :func:`make_plan` and :mod:`batchpid.plan`.
- Real motors and sensors: :func:`make_actuators` and :mod:`batchpid.motors`.
- Control of a tool: :mod:`batchpid.task_space`.
- In modules: setpoints in :mod:`batchpid.trajectories`, figures of merit in
  :mod:`batchpid.metrics`, gains per unit of inertia in :mod:`batchpid.law.computed_torque`, errors
  in :mod:`batchpid.errors`.

Requires NumPy alone; JAX and PyYAML are imported on first use.
"""

from batchpid import motors, plan
from batchpid.controller import BatchPID
from batchpid.errors import BatchPIDError, InvalidArgumentError, MissingDependencyError
from batchpid.gains.design import design_gains
from batchpid.gains.stability import stability_bound
from batchpid.io.documents import dumps_params, load_params, loads_params, save_params
from batchpid.io.files import attributes_of
from batchpid.law.bumpless import track
from batchpid.law.coefficients import Coefficients, discretise
from batchpid.law.params import PIDParams, make_params
from batchpid.law.pid import advance, init, reset, step
from batchpid.law.state import PIDState, Terms
from batchpid.motors import Actuators, load_actuators, make_actuators, save_actuators
from batchpid.motors.guard import Guard, make_guard
from batchpid.plan import Plan, load_plan, make_plan, save_plan

__version__ = "0.1.0"
"""Version of the package; pyproject.toml reads it here."""

__all__ = [
    "Actuators",
    "BatchPID",
    "BatchPIDError",
    "Coefficients",
    "Guard",
    "InvalidArgumentError",
    "MissingDependencyError",
    "PIDParams",
    "PIDState",
    "Plan",
    "Terms",
    "advance",
    "design_gains",
    "discretise",
    "dumps_params",
    "init",
    "load_actuators",
    "load_params",
    "load_plan",
    "loads_params",
    "make_actuators",
    "make_guard",
    "make_params",
    "make_plan",
    "motors",
    "plan",
    "reset",
    "save_actuators",
    "save_params",
    "save_plan",
    "stability_bound",
    "step",
    "track",
]

_MODULES = ("export", "metrics", "sim", "stages", "task_space", "trajectories")
"""Public modules, which are imported when they are used."""
__getattr__ = attributes_of(__name__, _MODULES)


def __dir__() -> list[str]:
    return [*__all__, *_MODULES]
