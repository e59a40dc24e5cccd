"""BatchPID: the stateful shell over the law, on NumPy or JAX. It owns the state and checks what comes in."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

from batchpid.backends import JAXBackend, NumPyBackend
from batchpid.bumpless import no_integral
from batchpid.errors import InvalidArgumentError
from batchpid.params import PIDParams
from batchpid.state import PIDState, Terms

BACKENDS = ("numpy", "jax")


class BatchPID:
    """A PID controller of (num_envs, joints) loops that remembers its state between calls.

    It starts from the first measurement it sees. Efforts come as arrays of the backend, in the params' dtype.

    Parameters
    ----------
    params
        From :func:`batchpid.make_params`, for 1 or ``num_envs`` envs.
    num_envs
        Number of envs.
    dt
        Time between calls [s].
    backend
        "numpy", or "jax": compiled once, with the state's buffers donated from call to call, and on a CPU block by
        block where the batch is large.
    terms
        Keep the :class:`batchpid.Terms` of the last call, at the cost of computing them.
    joint_names
        Used in error messages.

    Raises
    ------
    InvalidArgumentError
        Wrong backend, num_envs, dt or params.
    MissingDependencyError
        Backend "jax" without JAX.
    """

    def __init__(
        self,
        params: PIDParams,
        num_envs: int,
        dt: float,
        backend: str = "numpy",
        *,
        terms: bool = False,
        joint_names: Sequence[str] | None = None,
    ) -> None:
        if not isinstance(backend, str) or backend not in BACKENDS:
            raise InvalidArgumentError(
                "backend", "is unknown", value=backend, remedy=f"choose from {', '.join(BACKENDS)}"
            )
        if isinstance(num_envs, bool) or not isinstance(num_envs, int | np.integer) or num_envs < 1:
            raise InvalidArgumentError(
                "num_envs", "is not a whole number >= 1", value=num_envs, remedy="give the number of envs"
            )
        if isinstance(dt, bool) or not isinstance(dt, int | float | np.floating) or not 0 < dt <= sys.float_info.max:
            raise InvalidArgumentError("dt", "is not positive and finite", value=dt, remedy="give seconds > 0")
        if not isinstance(params, PIDParams):
            raise _no_params(params)
        self._dt, self._backend, self._names = float(dt), backend, joint_names
        self._shape = (int(num_envs), params.num_joints)
        self._engine = NumPyBackend(self._dt, terms) if backend == "numpy" else JAXBackend(self._dt, terms)
        self._keeps_terms = terms
        self._state: PIDState | None = None
        self._stale = False  # whether the state may lack leaves that the params now need
        self._terms: Terms | None = None
        self._params: PIDParams | None = None
        self.params = params

    def __repr__(self) -> str:
        started = "not started" if self._state is None else "started"
        envs, joints = self._shape
        return f"BatchPID({envs} envs, {joints} joints, dt {self._dt:g} s, backend {self._backend!r}, {started})"

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
    def params(self) -> PIDParams:
        """The parameters. Assign others at any time: they are checked, and the state carries on.

        A change of ki, limits or times makes no bump, since the integral is an effort. A change of kp or kd does,
        unless :meth:`track` follows it with the last effort.
        """
        assert self._params is not None
        return self._params

    @params.setter
    def params(self, params: PIDParams) -> None:
        if not isinstance(params, PIDParams):
            raise _no_params(params)
        if params.num_joints != self.num_joints:
            raise InvalidArgumentError(
                "params", f"hold {params.num_joints} joints, not {self.num_joints}", remedy="give one gain per joint"
            )
        params.check(self.num_envs, self._names)
        if self._params is not None and params.dtype != self._params.dtype:
            raise InvalidArgumentError(
                "params",
                f"are {params.dtype}, the controller's {self._params.dtype}",
                remedy="build them with that dtype, or a new BatchPID",
            )
        self._engine.prepare(params, self._shape)
        self._params, self._stale = params, self._state is not None

    @property
    def state(self) -> PIDState | None:
        """The law's state; None before the first measurement. With JAX it is valid until the next call."""
        return self._state

    @property
    def terms(self) -> Terms | None:
        """What the law did in the last call; None before the first."""
        if not self._keeps_terms:
            raise InvalidArgumentError("terms", "are not kept", remedy="build the BatchPID with terms=True")
        return self._terms

    def __call__(
        self,
        setpoint: Any,
        measurement: Any,
        measurement_rate: Any = None,
        setpoint_rate: Any = None,
        feedforward: Any = None,
    ) -> Any:
        """Return the effort (envs, joints) [N m or N]; arguments as in :func:`batchpid.step`.

        ``measurement`` is (envs, joints); the others may be anything that broadcasts to that.

        Raises
        ------
        InvalidArgumentError
            If a shape is wrong. The state is then as before.
        """
        r, y = self._array("setpoint", setpoint), self._measurement(measurement)
        y_rate = None if measurement_rate is None else self._array("measurement_rate", measurement_rate)
        r_rate = None if setpoint_rate is None else self._array("setpoint_rate", setpoint_rate)
        ff = None if feedforward is None else self._array("feedforward", feedforward)
        self._state, effort, self._terms = self._engine.step(self._started(y), r, y, y_rate, r_rate, ff)
        return effort

    def reset(self, measurement: Any, mask: Any = None, *, keep_integral: bool = False) -> None:
        """Start the envs of ``mask`` (envs,) bool, or all, anew from ``measurement`` (envs, joints)."""
        y = self._measurement(measurement)
        try:
            mask = np.ones(self.num_envs, bool) if mask is None else np.asarray(mask)
        except (TypeError, ValueError, RuntimeError) as error:
            raise InvalidArgumentError("mask", f"is no array: {error}", remedy="give one bool per env") from None
        if mask.dtype != bool or mask.shape != (self.num_envs,):
            raise InvalidArgumentError(
                "mask",
                f"is {mask.dtype} of shape {mask.shape}, not bool of shape ({self.num_envs},)",
                remedy="give one bool per env",
            )
        self._state = self._engine.reset(self._started(y), y, mask, keep_integral)

    def track(
        self,
        setpoint: Any,
        measurement: Any,
        effort: Any,
        measurement_rate: Any = None,
        setpoint_rate: Any = None,
        feedforward: Any = None,
    ) -> None:
        """Make the next call on these same inputs return ``effort``: bumpless, as :func:`batchpid.track`."""
        if self.params.ki is None:
            raise no_integral()
        r, y = self._array("setpoint", setpoint), self._measurement(measurement)
        u = self._array("effort", effort)
        y_rate = None if measurement_rate is None else self._array("measurement_rate", measurement_rate)
        r_rate = None if setpoint_rate is None else self._array("setpoint_rate", setpoint_rate)
        ff = None if feedforward is None else self._array("feedforward", feedforward)
        self._state = self._engine.track(self._started(y), r, y, u, y_rate, r_rate, ff)

    def _started(self, y: Any) -> PIDState:
        """Return the state, begun at the first measurement, and with every leaf that the params need."""
        if self._state is None:
            return self._engine.init(y)
        if self._stale:
            self._state, self._stale = self._state.matched_to(self._engine.init(y)), False
        return self._state

    def _numbers(self, name: str, value: Any) -> Any:
        try:
            return self._engine.array(value)
        except (TypeError, ValueError, RuntimeError, OverflowError) as error:
            raise InvalidArgumentError(
                name, f"cannot be read as an array of numbers: {error}", remedy="give an array of numbers"
            ) from None

    def _measurement(self, value: Any) -> Any:
        array = self._numbers("measurement", value)
        if array.shape != self._shape:
            raise InvalidArgumentError(
                "measurement", f"has shape {array.shape}, not {self._shape}", remedy="give (num_envs, joints)"
            )
        return array

    def _array(self, name: str, value: Any) -> Any:
        array = self._numbers(name, value)
        if array.shape == self._shape:
            return array
        envs, joints = self._shape
        if array.ndim <= 2 and all(n in (1, m) for n, m in zip(array.shape[::-1], (joints, envs), strict=False)):
            return array.reshape((1,) * (2 - array.ndim) + array.shape)
        raise InvalidArgumentError(
            name,
            f"has shape {array.shape}, which does not broadcast to {self._shape}",
            remedy="give a value for all, per joint, or per env and joint",
        )


def _no_params(value: Any) -> InvalidArgumentError:
    return InvalidArgumentError(
        "params", "are no PIDParams", value=type(value).__name__, remedy="build them with make_params"
    )
