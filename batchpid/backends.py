"""The law on NumPy and on JAX, run fast, as :class:`batchpid.BatchPID` calls it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Array
from batchpid.arrays.elementwise import precision, require_jax
from batchpid.law import pid
from batchpid.law.coefficients import discretise, spread
from batchpid.law.params import PIDParams
from batchpid.law.state import PIDState
from batchpid.native.array_program import obstacle
from batchpid.native.compiled import CompiledLaw


def declined(*_: object) -> Array:
    """Return NotImplemented, as a fast call does that leaves its work to Python."""
    return NotImplemented


class NumPyBackend:
    """The law on NumPy's arrays: by the native extension where there is one, else by NumPy, with
    the same bytes.

    Its coefficients are computed once; for NumPy they are spread over all envs.
    """

    def __init__(self, dt: float) -> None:
        self.dt = dt
        self.native = not obstacle()
        """Whether the native extension computes the law, which then writes over the arrays of the
        state.
        """

    def prepare(self, params: PIDParams, shape: tuple[int, int]) -> None:
        """Take params for (envs, joints) ``shape``."""
        self.params = params
        k = discretise(params, self.dt)
        self.coefficients = k if self.native else spread(k, shape[0])
        self._law = CompiledLaw(self.coefficients, shape[0]) if self.native else None

    def array(self, value: Array) -> Array:
        """Return ``value`` as an array of this backend."""
        return np.asarray(value, dtype=self.params.dtype)

    def call(self, function: Callable[..., PIDState], *inputs: Array) -> PIDState:
        """Return ``function(params, *inputs)``: init or reset of the law."""
        return function(self.params, *inputs)

    def step(
        self, state: PIDState, out: Array, *inputs: Array
    ) -> tuple[PIDState, Array, Callable[..., Array]]:
        """Return the new state, the effort, and a fast call of the next steps.

        The effort is ``out``, if that is not None. The fast call takes ``out`` and the inputs and
        returns the effort, or NotImplemented. It may be used while the state is the new one and
        nobody else holds its arrays.
        """
        if self._law is not None:
            return self._law.step(state, inputs, out)
        new, terms = pid.advance(self.coefficients, state, *inputs)
        if out is None:
            return new, terms.effort, declined
        out[...] = terms.effort
        return new, out, declined


class JAXBackend:
    """The law compiled by JAX: once per structure of params and inputs, with the state's buffers
    donated.
    """

    native = False

    def __init__(self, dt: float) -> None:
        require_jax()
        import jax

        self.jax = jax
        self.dtype: Any = None
        self._compiled: dict[Any, Any] = {}

        def step(params: PIDParams, state: PIDState, *inputs: Array) -> tuple[PIDState, Array]:
            new, terms = pid.advance(discretise(params, dt), state, *inputs)
            return new, terms.effort

        self._step = jax.jit(step, donate_argnums=1)

    def prepare(self, params: PIDParams, shape: tuple[int, int]) -> None:
        """Take params for (envs, joints) ``shape``."""
        with precision(self.dtype):
            self.params = self.jax.tree.map(self.jax.numpy.asarray, params)
        self.dtype = self.params.kp.dtype

    def array(self, value: Array) -> Array:
        """Return ``value`` as an array of this backend."""
        if isinstance(value, self.jax.Array) and value.dtype == self.dtype:
            return value
        # A copy: JAX may read it when the call has returned, and the caller writes to it.
        return np.array(value, dtype=self.dtype)

    def call(self, function: Callable[..., PIDState], *inputs: Array) -> PIDState:
        """Return ``function(params, *inputs)``: init or reset of the law."""
        if function not in self._compiled:
            self._compiled[function] = self.jax.jit(function)
        with precision(self.dtype):
            state: PIDState = self._compiled[function](self.params, *inputs)
            return state

    def step(
        self,
        state: PIDState,
        out: Array,
        *inputs: Array,
    ) -> tuple[PIDState, Array, Callable[..., Array]]:
        """Return the new state, the effort, and no fast call; ``out`` is None."""
        with precision(self.dtype):
            return *self._step(self.params, state, *inputs), declined
