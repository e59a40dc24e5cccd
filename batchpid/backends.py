"""The law on NumPy and on JAX, as :class:`batchpid.BatchPID` calls it: how to run it fast, and nothing else."""

from __future__ import annotations

from typing import Any

import numpy as np

from batchpid import bumpless, law
from batchpid.coefficients import discretise
from batchpid.errors import MissingDependencyError
from batchpid.params import PIDParams
from batchpid.state import PIDState, Terms

LARGE = 2**18
"""Envs from which JAX's CPU backend does them block by block: its own buffers then come from the system each time."""


class NumPyBackend:
    """Runs the law on NumPy, with the coefficients at hand and spread over all envs."""

    def __init__(self, dt: float, terms: bool) -> None:
        self.dt, self.terms = dt, terms

    def prepare(self, params: PIDParams, shape: tuple[int, int]) -> None:
        """Take these params for (envs, joints) ``shape``."""
        self.params, self.dtype = params, params.dtype
        self.coefficients = discretise(params, self.dt, shape[0])

    def array(self, value: Any) -> Any:
        """Return ``value`` as an array that the backend steps on."""
        return np.asarray(value, dtype=self.dtype)

    def init(self, y: Any) -> PIDState:
        """Return the state at a first measurement."""
        return law.init(self.params, y)

    def step(
        self, state: PIDState, r: Any, y: Any, y_rate: Any, r_rate: Any, ff: Any
    ) -> tuple[PIDState, Any, Terms | None]:
        """Return the new state, the effort, and the terms where they are kept."""
        new, effort, *terms = law.advance(self.coefficients, state, r, y, y_rate, r_rate, ff, self.terms)
        return new, effort, terms[0] if terms else None

    def reset(self, state: PIDState, y: Any, mask: Any, keep_integral: bool) -> PIDState:
        """Return the state with the envs of ``mask`` begun anew."""
        return law.reset(self.params, state, y, mask, keep_integral=keep_integral)

    def track(self, state: PIDState, r: Any, y: Any, u: Any, y_rate: Any, r_rate: Any, ff: Any) -> PIDState:
        """Return the state whose next step gives the effort ``u``."""
        rates = {"measurement_rate": y_rate, "setpoint_rate": r_rate}
        return bumpless.track(self.params, state, r, y, u, dt=self.dt, feedforward=ff, **rates)


class JAXBackend:
    """Runs the law compiled by JAX: once per structure of params and inputs, the state's buffers donated.

    A call costs JAX some 4 us per array, so the params that all envs share travel as one.
    """

    def __init__(self, dt: float, terms: bool) -> None:
        try:
            import jax
        except ImportError:
            raise MissingDependencyError("jax", "backend='jax'", "jax") from None
        from batchpid.blocks import advance_in_blocks

        self.jax, self.terms = jax, terms
        self._spare: PIDState | None = None  # the state before the last, to write over

        def step(
            params: PIDParams, state: PIDState, r: Any, y: Any, y_rate: Any, r_rate: Any, ff: Any
        ) -> tuple[PIDState, Any, Terms | None]:
            k = discretise(params, dt)
            new, effort, *shown = law.advance(k, state, r, y, y_rate, r_rate, ff, terms)
            return new, effort, shown[0] if shown else None

        def step_in_blocks(params: PIDParams, spare: PIDState, state: PIDState, *inputs: Any) -> Any:
            out = (spare, jax.numpy.zeros_like(inputs[1]))
            return advance_in_blocks(discretise(params, dt), state, *inputs, out=out)

        def reset(params: PIDParams, state: PIDState, y: Any, mask: Any) -> PIDState:
            return law.reset(params, state, y, mask)

        def reset_but_integral(params: PIDParams, state: PIDState, y: Any, mask: Any) -> PIDState:
            return law.reset(params, state, y, mask, keep_integral=True)

        def track(
            params: PIDParams, state: PIDState, r: Any, y: Any, u: Any, y_rate: Any, r_rate: Any, ff: Any
        ) -> PIDState:
            rates = {"measurement_rate": y_rate, "setpoint_rate": r_rate}
            return bumpless.track(params, state, r, y, u, dt=dt, feedforward=ff, **rates)

        self._init = self._compiled(law.init)
        self._step = self._compiled(step, donate_argnums=3)
        self._step_in_blocks = self._compiled(step_in_blocks, donate_argnums=3)
        self._reset, self._reset_but_integral = self._compiled(reset), self._compiled(reset_but_integral)
        self._track = self._compiled(track)

    def _compiled(self, function: Any, **options: Any) -> Any:
        """Return a function of params and more, compiled as one of packed params: layout, shared, own."""

        def packed(layout: Any, shared: Any, own: Any, *inputs: Any) -> Any:
            tree, is_shared = layout
            shared, own = iter(shared), iter(own)
            leaves = [next(shared if one else own) for one in is_shared]
            return function(self.jax.tree.unflatten(tree, leaves), *inputs)

        return self.jax.jit(packed, static_argnums=0, **options)

    def prepare(self, params: PIDParams, shape: tuple[int, int]) -> None:
        """Take these params for (envs, joints) ``shape``."""
        jnp = self.jax.numpy
        leaves, tree = self.jax.tree.flatten(params)
        is_shared = tuple(leaf.shape[0] == 1 for leaf in leaves)
        shared = [np.asarray(leaf) for leaf, one in zip(leaves, is_shared, strict=True) if one]
        own = [jnp.asarray(leaf) for leaf, one in zip(leaves, is_shared, strict=True) if not one]
        stacked = np.stack(shared) if shared else np.empty((0, 1, shape[1]), params.dtype)
        self.packed = ((tree, is_shared), jnp.asarray(stacked), own)
        self.dtype, self._spare = self.packed[1].dtype, None

    def array(self, value: Any) -> Any:
        """Return ``value`` as an array that the backend steps on."""
        if isinstance(value, self.jax.Array) and value.dtype == self.dtype:
            return value
        return np.asarray(value, dtype=self.dtype)

    def init(self, y: Any) -> PIDState:
        """Return the state at a first measurement."""
        return self._init(*self.packed, y)

    def step(
        self, state: PIDState, r: Any, y: Any, y_rate: Any, r_rate: Any, ff: Any
    ) -> tuple[PIDState, Any, Terms | None]:
        """Return the new state, the effort, and the terms where they are kept."""
        if y.shape[0] < LARGE or self.terms or not self._on_one_cpu(y):
            return self._step(*self.packed, state, r, y, y_rate, r_rate, ff)
        spare = self.jax.tree.map(self.jax.numpy.zeros_like, state) if self._spare is None else self._spare
        new, effort = self._step_in_blocks(*self.packed, spare, state, r, y, y_rate, r_rate, ff)
        self._spare = state
        return new, effort, None

    def _on_one_cpu(self, y: Any) -> bool:
        devices = y.devices() if isinstance(y, self.jax.Array) else self.jax.local_devices()[:1]
        return [device.platform for device in devices] == ["cpu"]

    def reset(self, state: PIDState, y: Any, mask: Any, keep_integral: bool) -> PIDState:
        """Return the state with the envs of ``mask`` begun anew."""
        function = self._reset_but_integral if keep_integral else self._reset
        return function(*self.packed, state, y, mask)

    def track(self, state: PIDState, *inputs: Any) -> PIDState:
        """Return the state whose next step gives the effort ``u``."""
        return self._track(*self.packed, state, *inputs)
