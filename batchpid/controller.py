"""BatchPID: the stateful shell over the law, on NumPy or JAX. It owns the state, checks shapes and starts the law."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from batchpid import law
from batchpid.coefficients import discretise
from batchpid.errors import InvalidArgumentError, MissingDependencyError
from batchpid.params import PIDParams
from batchpid.state import PIDState

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
        "numpy", or "jax": compiled once, with the state's buffers donated from call to call.
    joint_names
        Used in error messages.

    Raises
    ------
    InvalidArgumentError
        Wrong backend, num_envs, dt or params.
    MissingDependencyError
        backend "jax" without JAX.
    """

    def __init__(
        self,
        params: PIDParams,
        num_envs: int,
        dt: float,
        backend: str = "numpy",
        *,
        joint_names: Sequence[str] | None = None,
    ) -> None:
        if backend not in BACKENDS:
            raise InvalidArgumentError(
                "backend", "is unknown", value=backend, remedy=f"choose from {', '.join(BACKENDS)}"
            )
        if isinstance(num_envs, bool) or not isinstance(num_envs, int | np.integer) or num_envs < 1:
            raise InvalidArgumentError(
                "num_envs", "is not a whole number >= 1", value=num_envs, remedy="give the number of envs"
            )
        if not isinstance(dt, int | float | np.floating) or not 0 < dt < math.inf:
            raise InvalidArgumentError(
                "dt", "is not positive and finite", value=dt, remedy="give seconds > 0"
            )
        self.num_envs, self.dt, self.backend = int(num_envs), float(dt), backend
        self.joint_names = joint_names
        self._engine = _NumPy(self.dt) if backend == "numpy" else _JAX(self.dt)
        self._state: Any = None
        self._params: Any = None
        self.params = params

    @property
    def joints(self) -> int:
        """Number of joints."""
        return int(self._params.joints)

    @property
    def params(self) -> PIDParams:
        """The parameters; assign others at any time, the integral carries on without a bump."""
        return self._params

    @params.setter
    def params(self, params: PIDParams) -> None:
        if not isinstance(params, PIDParams):
            raise InvalidArgumentError(
                "params",
                "are no PIDParams",
                value=type(params).__name__,
                remedy="build them with make_params",
            )
        if params.num_envs not in (1, self.num_envs):
            raise InvalidArgumentError(
                "params",
                f"are for {params.num_envs} envs, not {self.num_envs}",
                remedy="slice or rebuild them",
            )
        self._params = params
        self._engine.prepare(params, (self.num_envs, params.joints))

    @property
    def state(self) -> PIDState | None:
        """The law's state; None before the first measurement."""
        return self._state

    def __call__(
        self,
        setpoint: Any,
        measurement: Any,
        measurement_rate: Any = None,
        setpoint_rate: Any = None,
        feedforward: Any = None,
    ) -> Any:
        """Return the effort (envs, joints) [N m or N]; arguments as in :func:`batchpid.step`."""
        engine = self._engine
        y = engine.array(measurement)
        if self._state is None:
            self._state = law.init(engine.params, y)
        self._state, effort = engine.step(
            self._state, engine.array(setpoint), y, measurement_rate, setpoint_rate, feedforward
        )
        return effort

    def reset(self, measurement: Any, mask: Any = None, *, keep_integral: bool = False) -> None:
        """Start the envs of ``mask`` (all of them for None) anew from ``measurement`` (envs, joints)."""
        y = self._engine.array(measurement)
        if self._state is None:
            self._state = law.init(self._engine.params, y)
            return
        mask = np.ones(self.num_envs, dtype=bool) if mask is None else mask
        self._state = law.reset(self._engine.params, self._state, y, mask, keep_integral=keep_integral)

    def track(self, setpoint: Any, measurement: Any, effort: Any, **inputs: Any) -> None:
        """Make the next call on these inputs return ``effort``: bumpless transfer, as :func:`batchpid.track`."""
        array = self._engine.array
        y = array(measurement)
        state = law.init(self._engine.params, y) if self._state is None else self._state
        self._state = law.track(
            self._engine.params, state, array(setpoint), y, array(effort), dt=self.dt, **inputs
        )


class _NumPy:
    """Runs the law on NumPy, with the coefficients at hand and spread over all envs."""

    def __init__(self, dt: float) -> None:
        self.dt = dt

    def prepare(self, params: PIDParams, shape: tuple[int, int]) -> None:
        self.params = PIDParams(
            *(np.array(np.broadcast_to(p, shape)) if isinstance(p, np.ndarray) else p for p in params)
        )
        self.coefficients = discretise(self.params, self.dt)

    def array(self, value: Any) -> Any:
        return np.asarray(value, dtype=self.params.dtype)

    def step(self, state: Any, *inputs: Any) -> Any:
        return law.advance(self.coefficients, state, *inputs)


class _JAX:
    """Runs the law compiled by JAX: once per structure of params and inputs."""

    def __init__(self, dt: float) -> None:
        try:
            import jax
        except ImportError:
            raise MissingDependencyError("jax", "backend='jax'", "jax") from None
        self.dt, self.jax = dt, jax

        def step(params: PIDParams, state: Any, r: Any, y: Any, y_rate: Any, r_rate: Any, ff: Any) -> Any:
            k = discretise(params, dt)
            return law.advance(k, state, r, y, y_rate, r_rate, ff)

        self._step = jax.jit(step, donate_argnums=1)

    def prepare(self, params: PIDParams, shape: tuple[int, int]) -> None:
        self.params = self.jax.tree.map(self.jax.numpy.asarray, params)

    def array(self, value: Any) -> Any:
        return self.jax.numpy.asarray(value, dtype=self.params.dtype)

    def step(self, state: Any, *inputs: Any) -> Any:
        return self._step(self.params, state, *inputs)
