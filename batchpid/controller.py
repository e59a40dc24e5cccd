"""BatchPID: the law with its state, on NumPy or JAX; arguments are checked here."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from batchpid.arrays.array_types import Array
from batchpid.arrays.elementwise import read_only
from batchpid.arrays.records import frozen
from batchpid.arrays.trees import mapped
from batchpid.backends import JAXBackend, NumPyBackend, declined
from batchpid.checks import (
    choice,
    env_mask,
    instance,
    integer,
    names,
    read_array,
    time_step,
)
from batchpid.errors import InvalidArgumentError, SingleOwner
from batchpid.law import pid
from batchpid.law.params import PIDParams
from batchpid.law.state import PIDState, check_alone

BACKENDS: dict[str, type[NumPyBackend | JAXBackend]] = {"numpy": NumPyBackend, "jax": JAXBackend}
MOST_ENVS = 2**31


class BatchPID(SingleOwner):
    """PID controller of (num_envs, joints) loops that keeps its state between calls.

    It starts from the first measurement. Efforts are arrays of the backend, in the params' dtype,
    and new in each call.

    Parameters
    ----------
    params
        From :func:`batchpid.make_params`, for 1 or ``num_envs`` envs.
    num_envs
        Number of envs.
    dt
        Time between calls [s].
    backend
        "numpy": computed by the native extension where that was built, with the bytes of NumPy but
        without its floating-point warnings. Or "jax": compiled once, with the state's buffers
        donated from call to call.
    joint_names
        Used in error messages.

    Raises
    ------
    InvalidArgumentError
        Wrong backend, num_envs, dt or params.
    MissingDependencyError
        Backend "jax" without JAX.
    """

    instead = "keep params and a state of batchpid.step"

    def __init__(
        self,
        params: PIDParams,
        num_envs: int,
        dt: float,
        backend: str = "numpy",
        *,
        joint_names: Sequence[str] | None = None,
    ) -> None:
        # Sizes first: the params, the names and the engine are checked against them.
        self._backend, self._dt = choice("backend", backend, BACKENDS), time_step("dt", dt)
        self._shape = (integer("num_envs", num_envs, 1, MOST_ENVS), _checked(params).num_joints)
        self._names: list[str] | None = None
        if joint_names is not None:
            self._names = names("joint_names", joint_names, self.num_joints)
        self._engine = BACKENDS[self._backend](self._dt)
        self._state: PIDState | None = None
        self._fast = declined  # fast call of the law on this very state
        self._stale = False  # whether the state may lack leaves that the params now need
        self._params = params
        self.params = params

    @property
    def num_envs(self) -> int:
        """Number of envs."""
        return self._shape[0]

    @property
    def num_joints(self) -> int:
        """Number of joints."""
        return self._shape[1]

    @property
    def dt(self) -> float:
        """Time between calls [s]."""
        return self._dt

    @property
    def backend(self) -> str:
        """Name of the array library: "numpy" or "jax"."""
        return self._backend

    @property
    def native(self) -> bool:
        """Whether the native extension computes the law."""
        return self._engine.native

    @property
    def params(self) -> PIDParams:
        """Params of the law. Assign others at any time: they are checked, and the state is kept.

        A change of ki, limits or times makes no bump, since the integral is an effort. A change of
        kp or kd does; the pure functions have :func:`batchpid.track` for it.
        """
        return self._params

    @params.setter
    def params(self, params: PIDParams) -> None:
        if _checked(params).num_joints != self.num_joints:
            problem = f"are for {params.num_joints} joints, not {self.num_joints}"
            raise InvalidArgumentError("params", problem, remedy="give one gain per joint")
        params.check(self.num_envs, self._names)
        check_alone(params._replace(measurement_rate=None), None)
        if params.dtype != self._params.dtype:
            problem = f"are {params.dtype}, the controller's {self._params.dtype}"
            raise InvalidArgumentError(
                "params", problem, remedy="build them with that dtype, or a new BatchPID"
            )
        # A later write by the caller would reach compiled constants, or not.
        params = frozen(params)
        self._engine.prepare(params, self._shape)
        self._params = params
        self._stale = self._state is not None
        self._fast = declined

    @property
    def state(self) -> PIDState | None:
        """Copy of the state of the law, read-only; None before the first measurement."""
        if self._state is None:
            return None
        copied: PIDState = mapped(lambda leaf: read_only(leaf.copy()), self._state)
        return copied

    def __call__(
        self,
        setpoint: Array,
        measurement: Array,
        measurement_rate: Array = None,
        setpoint_rate: Array = None,
        feedforward: Array = None,
        *,
        out: Array = None,
    ) -> Array:
        """Return the effort (envs, joints) [N m or N]; arguments as in :func:`batchpid.step`.

        ``measurement`` is (envs, joints); the others may be anything that broadcasts to that.
        ``out`` is an array to write the effort to and to return, of the params' dtype: with many
        envs, the pages of a new one cost more than the law. It may be one of the inputs. Where a
        shape is wrong, InvalidArgumentError is raised and the state is unchanged.
        """
        if measurement_rate is None:
            check_alone(self._params, None)
        effort = self._fast(
            out,
            setpoint,
            measurement,
            measurement_rate,
            setpoint_rate,
            feedforward,
        )
        if effort is not NotImplemented:
            return effort
        # All arguments are read before the state changes.
        r = self._array("setpoint", setpoint)
        y = self._array("measurement", measurement, exact=True)
        rest = {
            "measurement_rate": measurement_rate,
            "setpoint_rate": setpoint_rate,
            "feedforward": feedforward,
        }
        optional = [
            None if value is None else self._array(name, value) for name, value in rest.items()
        ]
        if out is not None:
            self._check_out(out)
        state = self._started(y)
        self._state, effort, self._fast = self._engine.step(state, out, r, y, *optional)
        return effort

    def reset(self, measurement: Array, mask: Array = None) -> None:
        """Restart the envs of ``mask`` (envs,) bool, or all, from ``measurement`` (envs,
        joints).
        """
        y = self._array("measurement", measurement, exact=True)
        if mask is None:
            mask = np.ones(self.num_envs, bool)
        else:
            mask = env_mask("mask", mask, self.num_envs)
        self._fast = declined
        self._state = self._engine.call(pid.reset, self._started(y), y, mask)

    def _started(self, y: Array) -> PIDState:
        """Return the state, begun at the first measurement, with every leaf that the params
        need.
        """
        if self._state is None:
            return self._engine.call(pid.init, y)
        if self._stale:
            self._state = self._state.matched_to(self._engine.call(pid.init, y))
            self._stale = False
        return self._state

    def _check_out(self, out: Array) -> None:
        if self._backend != "numpy":
            problem = "is for backend 'numpy' alone"
            raise InvalidArgumentError("out", problem, remedy="leave it out")
        dtype = self._params.dtype
        fits = isinstance(out, np.ndarray) and out.dtype == dtype and out.shape == self._shape
        if not fits or not out.flags.carray:
            problem = f"must be a contiguous, writeable array of {dtype} {self._shape}"
            raise InvalidArgumentError("out", problem, remedy="give one, or leave it out")

    def _array(self, name: str, value: Array, exact: bool = False) -> Array:
        """Return ``value`` as an array of the backend that broadcasts to (envs, joints), or is
        ``exact``-ly that.
        """
        if isinstance(value, np.ndarray) or not hasattr(value, "__array_namespace__"):
            value = read_array(name, value)
        array = self._engine.array(value)
        if array.shape == self._shape:
            return array
        if exact:
            problem = f"has shape {array.shape}, not {self._shape}"
            raise InvalidArgumentError(name, problem, remedy="give (num_envs, joints)")
        envs, joints = self._shape
        # A view with two axes: the law takes (1 | envs, 1 | joints).
        if array.ndim <= 2 and all(
            n in (1, m) for n, m in zip(array.shape[::-1], (joints, envs), strict=False)
        ):
            return array.reshape((1,) * (2 - array.ndim) + array.shape)
        problem = f"has shape {array.shape}, which does not broadcast to {self._shape}"
        raise InvalidArgumentError(
            name, problem, remedy="give one value, one per joint, or one per env and joint"
        )


def _checked(params: object) -> PIDParams:
    return instance("params", params, PIDParams, "build them with make_params")
