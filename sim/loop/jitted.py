"""Laws compiled by JAX, and called once per sim step where the sim steps of a tick cannot be one program."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid.coefficients import Coefficients
from batchpid.jax_settings import own_settings
from sim.engine.protocol import EnginePack as Pack
from sim.engine.scene_spec import SceneSpec
from sim.loop.control import CONTROLS, Control, PIDControl
from sim.loop.custom import CustomControl
from sim.loop.pid_law import PIDLaw
from sim.options import Precision, RunnerOptions
from sim.robot.actuators import known_joints

Float64 = NDArray[np.float64]
ROWS = 16
"""The first axis of arrays in a program of JAX is a multiple of this, whatever the number of envs in a group.

So one program serves all groups, and an env's results do not depend on its group.
"""


def program_rows(envs: int) -> int:
    """Return the rows of a program for so many envs."""
    return -(-envs // ROWS) * ROWS


def padded(rows: Any) -> NDArray[Any]:
    """Return ``rows`` (envs, ...) followed by copies of the first, up to the rows of a program."""
    rows = np.asarray(rows)
    missing = program_rows(len(rows)) - len(rows)
    return np.concatenate([rows, np.repeat(rows[:1], missing, 0)]) if missing else rows


def put(tree: Any) -> Any:
    """Return a structure of arrays on the CPU, as JAX's."""
    import jax

    return jax.device_put(tree, jax.local_devices(backend="cpu")[0])


def make_control(options: RunnerOptions, scene: SceneSpec, params: bp.PIDParams, plant: Pack) -> Control:
    """Return the control that ``options`` ask for, of the robots ``plant``."""
    jitted = options.backend == "jax"
    if not isinstance(options.control, str):
        kind = JittedCustomControl if jitted else CustomControl
        control: Control = kind(options, scene, params, plant)
    else:
        known = None if options.robot.actuators is None else known_joints(options.robot)
        of_name = CONTROLS | {"pid": JittedPIDControl} if jitted else CONTROLS
        control = of_name[options.control](scene, params, plant, known)
    if isinstance(control, JittedPIDControl):
        control.options = options
    return control


class JittedPIDControl(PIDControl):
    """PID control, with the law compiled by JAX."""

    options: RunnerOptions

    def _advance(self, k: Coefficients, *inputs: Any, terms: bool) -> Any:
        arguments = (k, self._state, *inputs)
        new, effort, *shown = _call(_law(self.law, terms), self.options.dtype, len(self.saturated), *arguments)
        return new, effort, *(each.saturated for each in shown)


class JittedCustomControl(CustomControl):
    """Control by the caller's own controller, compiled by JAX."""

    def _call(self, *inputs: Float64) -> Any:
        call, state = _controller(self.options, self), self.read()
        new, effort = _call(call, self.options.dtype, len(self.saturated), state, *inputs)
        self.write(new, self.saturated)
        return effort


def shared_call(options: RunnerOptions, control: CustomControl) -> Callable[..., Any]:
    """Return :meth:`CustomControl.call` of one of a runner's groups, the same for all of them."""
    first = _first_control(options)
    if not first:
        first.append(control)
    return first[0].call


@lru_cache(maxsize=8)
def _first_control(options: RunnerOptions) -> list[CustomControl]:
    return []


@lru_cache(maxsize=8)
def _law(law: PIDLaw, terms: bool) -> Any:
    import jax

    return jax.jit(partial(law.advance, terms=terms))


def _controller(options: RunnerOptions, control: CustomControl) -> Any:
    return _jitted(shared_call(options, control))


@lru_cache(maxsize=8)
def _jitted(call: Callable[..., Any]) -> Any:
    import jax

    return jax.jit(call)


def _call(function: Any, dtype: Precision, envs: int, *inputs: Any) -> Any:
    """Return a structure of arrays (envs, ...) that a function of such, compiled by JAX, returns."""
    import jax

    with own_settings(dtype):
        results = function(*put(jax.tree.map(padded, inputs)))
        return jax.tree.map(lambda rows: np.array(rows)[:envs], results)
