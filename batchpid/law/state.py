"""State of the law between steps, the terms of one step, and the checks of arguments: types, shapes
and dtypes, which JAX knows while it traces. Of the values, only a time step is read.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from batchpid.arrays.array_types import Array
from batchpid.arrays.elementwise import in_dtype_of
from batchpid.arrays.records import Record, array_summary
from batchpid.checks import instance, read_array, time_step
from batchpid.errors import InvalidArgumentError
from batchpid.law.params import PIDParams


class _PIDStateFields(NamedTuple):
    integral: Array = None
    """I, in effort units."""
    measurement: Array = None
    """y of the last step [rad or m]."""
    derivative: Array = None
    """d, the filtered rate of c r - y [rad/s or m/s]."""
    setpoint: Array = None
    """r of the last step [rad or m]."""
    setpoint_seen: Array = None
    """1.0 once ``setpoint`` holds a value to take a difference from, else 0.0."""
    effort: Array = None
    """Effort of the last step [N m or N]."""
    origin: Array = None
    """o: where setpoint weighting measures positions from [rad or m]."""


class PIDState(Record, _PIDStateFields):
    """State of the law, arrays (envs, joints); None where no option needs it."""

    __slots__ = ()
    NAME = "state"


class Terms(NamedTuple):
    """Terms of the law in one step, each (envs, joints); 0.0 for a term that is off."""

    p: Array
    """Proportional term [N m or N]."""
    i: Array
    """Integral term as it entered the effort."""
    d: Array
    """Derivative term."""
    feedforward: Array
    """Feedforward as given."""
    unsaturated: Array
    """Their sum: the computed effort."""
    effort: Array
    """The applied effort, which differs where a limit (of the effort or its rate) acts."""

    def __repr__(self) -> str:
        return array_summary(self)


DRIVE_LACKS = (
    "effort_rate_limit",
    "derivative_filter_time",
    "setpoint_weight",
    "setpoint_weight_derivative",
    "deadband",
)
"""Options that change P, D or the effort in a way that no target of a drive can."""


def checked_inputs(
    params: PIDParams,
    state: PIDState,
    measurement: Array,
    **inputs: Array,
) -> list[Array]:
    """Return ``measurement`` and ``inputs`` as arrays in the params' dtype that broadcast with
    params and state.

    None stays None.
    """
    instance("params", params, PIDParams, "build them with make_params")
    instance("state", state, PIDState, "begin with init(params, measurement)")
    arrays = {"measurement": _as_array("measurement", measurement)}
    arrays |= {
        name: None if value is None else _as_array(name, value) for name, value in inputs.items()
    }
    named = [("params", leaf) for leaf in params if not isinstance(leaf, tuple)]
    named += [*(("state", leaf) for leaf in state), *arrays.items()]
    shapes = [(name, array.shape) for name, array in named if array is not None]
    whole = arrays["measurement"].shape
    joints = params.num_joints
    # One look suffices where all are (envs, joints), and saves most of the time.
    usual = {whole, (1, joints)}
    if whole[-1:] != (joints,) or not usual.issuperset(shape for _, shape in shapes):
        _check_shapes(shapes, joints)
    return in_dtype_of(params, *arrays.values())


def check_alone(law: Any, measurement_rate: Array) -> None:
    """Raise InvalidArgumentError if params or coefficients need a mass matrix, or a measured rate
    that is not given.
    """
    if law.gain_units is not None:
        raise InvalidArgumentError(
            "params.gain_units",
            "are accelerations: without the robot's mass matrix the law cannot turn them into"
            " efforts",
            value="mass_matrix",
            remedy=(
                "use gains in efforts, such as robot.designed('effort'), or a batchpid.sim.Runner"
            ),
        )
    if law.measurement_rate is not None and law.kd is not None and measurement_rate is None:
        raise InvalidArgumentError(
            "measurement_rate",
            "is missing: the params have measurement_rate='measured'",
            remedy=(
                "pass the measured velocity, or use params.replace(measurement_rate='difference')"
            ),
        )


def check_drive(params: PIDParams) -> None:
    """Raise InvalidArgumentError for options of the law that a drive of stiffness kp and damping kd
    does not have.
    """
    lacking = [name for name in DRIVE_LACKS if getattr(params, name) is not None]
    if lacking:
        others = ", ".join(f"{name}=None" for name in lacking)
        raise InvalidArgumentError(
            f"params.{lacking[0]}",
            "is not available in a drive, whose effort is kp (target - y) - kd dy/dt within the"
            " effort limits",
            remedy=f"use params.replace({others}), or the PID law, as in control 'pid'",
        )


def _check_shapes(shapes: list[tuple[str, tuple[int, ...]]], joints: int) -> None:
    """Raise InvalidArgumentError for the first of the named ``shapes`` that does not broadcast with
    those before.
    """
    whole: tuple[int, ...] = (joints,)
    for name, shape in shapes:
        try:
            whole = np.broadcast_shapes(whole, shape)
            fits = whole[-1] == joints and (name != "measurement" or shape[-1:] == (joints,))
        except ValueError:
            fits = False
        if not fits:
            problem = (
                f"has shape {shape}, which does not fit {whole} of the params and the other inputs"
            )
            raise InvalidArgumentError(name, problem, remedy=f"give (envs, {joints})")


def needs(params: PIDParams) -> PIDState:
    """Return which leaves of a state the params need, as bools."""
    differentiates = params.kd is not None
    weights = params.setpoint_weight is not None
    weights_rate = differentiates and params.setpoint_weight_derivative is not None
    return PIDState(
        integral=params.ki is not None,
        measurement=differentiates or (weights and params.continuous is not None),
        derivative=differentiates and params.derivative_filter_time is not None,
        setpoint=weights_rate,
        setpoint_seen=weights_rate,
        effort=params.effort_rate_limit is not None,
        origin=weights,
    )


def check_state(state: PIDState, params: PIDParams) -> None:
    """Raise InvalidArgumentError unless ``state`` has every leaf that the params need."""
    for name, need in needs(params)._asdict().items():
        if need and getattr(state, name) is None:
            remedy = (
                "begin with init(params, measurement), or use state.matched_to(init(params,"
                " measurement))"
            )
            raise InvalidArgumentError(
                "state", f"has no {name}, which these params need", remedy=remedy
            )


def checked_mask(mask: Array, state: PIDState) -> Array:
    """Return ``mask`` as bools, one for each env of ``state``; () for one robot."""
    array = _as_array("mask", mask, "b")
    shape = np.broadcast_shapes(*(leaf.shape for leaf in state if leaf is not None))
    envs = shape[:-1]
    if array.dtype.kind != "b" or array.ndim > 1 or (shape and array.shape != envs):
        problem = f"is {array.dtype} {array.shape}, not bool {envs}"
        raise InvalidArgumentError("mask", problem, remedy="give one bool per env")
    return array


def checked_dt(dt: Array) -> Array:
    """Return ``dt`` as a float if it is positive and finite; an array of JAX is returned unread.

    A number of NumPy would give its own dtype to the efforts.
    """
    if isinstance(dt, np.ndarray | np.generic):
        dt = dt.tolist()
    if hasattr(dt, "__array_namespace__"):
        return dt
    return time_step("dt", dt)


def _as_array(name: str, value: Array, kinds: str = "iuf") -> Array:
    """Return ``value`` as an array of NumPy; arrays of JAX are returned unchanged."""
    is_own = type(value) is np.ndarray
    if (is_own and value.dtype.kind in kinds) or (
        not is_own and hasattr(value, "__array_namespace__")
    ):
        return value
    return read_array(name, value, kinds)
