"""Sim steps of a tick as one program of XLA: compensation, law, friction, and the engine by a call of the extension.

The program is a loop over the sim steps, ``lax.while_loop``, whose body traces the functions that the loop in NumPy
calls and ends with :func:`sim.engine.native.xla.sim_step`. It ends early where Python has to look: a contact may come,
or an env has failed. All groups have the same number of rows (:mod:`sim.loop.jitted`), so that one program serves
them all.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid import friction as friction_model
from batchpid.coefficients import Coefficients
from batchpid.elementwise import clip
from batchpid.friction import Friction, FrictionState
from sim.engine.native import xla
from sim.loop.arrays import Command
from sim.loop.friction import REFRESH_STEPS, KnownFriction
from sim.loop.pid_law import MASS_MATRIX_STEPS, PIDLaw, half_way

Float64 = NDArray[np.float64]


class Layout(NamedTuple):
    """Everything about a program that is not in an array: programs of equal layouts are the same."""

    law: PIDLaw | None
    """Of control "pid"."""
    controller: Callable[..., Any] | None
    """The caller's own, :meth:`sim.loop.custom.CustomControl.call`; without both the setpoint is the effort."""
    compensates: bool
    """Compensate the known friction."""


class Constants(NamedTuple):
    """Arrays that stay the same for many ticks; None where they are not needed."""

    timestep: Any
    k: Coefficients | None
    limits: tuple[Any, Any]
    """Limits of the effort, of a law that does not limit it."""
    damping: Any
    """Viscous damping that the law compensates (dof,)."""
    tree: Any
    """With ``bodies``: arguments of :func:`sim.engine.native.xla.mass_matrix`."""
    bodies: Any
    friction: Friction
    known: KnownFriction


class Carry(NamedTuple):
    """State of the loop over sim steps; arrays (rows, dof) unless said otherwise."""

    progress: Any
    """Sim steps done in this tick, and the last status (2,)."""
    law: dict[str, Any]
    friction: FrictionState
    age: Any
    """(rows,)"""
    matrix: Any
    """Mass matrix in use (rows, dof, dof), or its diagonal; None without gains per these."""
    qpos_before: Any
    qpos: Any
    qvel: Any
    passive: Any
    motor: Any
    """Effort of the motors in the last sim step."""
    saturated: Any


def tick(layout: Layout, span: Any, constants: Constants, carry: Carry, command: Command) -> Carry:
    """Return the state after some sim steps of a tick, or after the first of them that has a status.

    ``span`` (4,) of int32 holds the first step, the step after the last, and the address of the group in two parts, as
    each array from NumPy costs a call some microseconds.
    """
    import jax
    from jax import lax

    end, address = span[1], lax.bitcast_convert_type(span[2:], np.uint32)
    xp, law, model = jax.numpy, layout.law, constants.friction

    def mass_matrix(qpos: Any) -> Any:
        return xla.mass_matrix(constants.tree, constants.bodies, qpos)

    def law_matrix(carry: Carry) -> Any:
        steps = xp.minimum(MASS_MATRIX_STEPS, end - carry.progress[0]).astype(carry.qpos.dtype)
        matrix = mass_matrix(half_way(carry.qpos, carry.qvel, steps, constants.timestep))
        if constants.damping is not None:
            matrix = matrix + constants.timestep * xp.diag(constants.damping)
        return matrix if law is not None and law.whole else xp.einsum("ejj->ej", matrix)

    def control(carry: Carry, forward: Any) -> tuple[dict[str, Any], Any, Any, Any]:
        """Return state of the law, effort, saturated joints, and the matrix."""
        setpoint, setpoint_rate, _ = command
        matrix = carry.matrix
        if law is not None and constants.k is not None:
            if matrix is not None:
                due = carry.progress[0] % MASS_MATRIX_STEPS == 0
                matrix = lax.cond(due, law_matrix, lambda carry: carry.matrix, carry)
            k = constants.k if matrix is None or law.whole else law.scaled(constants.k, matrix)
            viscous = None if constants.damping is None else constants.damping * carry.qvel
            inputs = ((setpoint, setpoint_rate), carry.qpos, carry.qvel, forward, matrix, viscous)
            state, effort, terms = law.advance(k, bp.PIDState(**carry.law), *inputs, terms=True)
            return state.leaves(), effort, terms.saturated, matrix
        state, total = carry.law, setpoint + forward
        if layout.controller is not None:
            state, total = layout.controller(carry.law, setpoint, carry.qpos, carry.qvel, forward)
        effort = clip(total, *constants.limits, xp)
        return state, effort, effort != total, matrix

    def refresh(carry: Carry) -> FrictionState:
        due = carry.age == REFRESH_STEPS
        fresh = friction_model.refresh(model, carry.friction, mass_matrix(carry.qpos), constants.timestep)
        return friction_model.reset(carry.friction, fresh, due)

    def body(carry: Carry) -> Carry:
        forward = carry.passive if command.feedforward is None else carry.passive + command.feedforward
        if layout.compensates:
            forward = constants.known.feedforward(command, carry.qpos) + forward
        state, motor, saturated, matrix = control(carry, forward)
        rubbing, age = carry.friction, carry.age
        if model.coulomb is not None:
            due = age == REFRESH_STEPS
            rubbing = lax.cond(due.any(), refresh, lambda carry: carry.friction, carry)
            age = xp.where(due, 0, age) + 1
        rubbing, effort = friction_model.advance(model, rubbing, motor, carry.qvel)
        qpos, qvel, passive, status = xla.sim_step(address, carry.progress[0], effort)
        progress = xp.stack([carry.progress[0] + 1, status])
        return Carry(progress, state, rubbing, age, matrix, carry.qpos, qpos, qvel, passive, motor, saturated)

    carry = carry._replace(progress=xp.stack([span[0], xp.zeros_like(end)]))
    return lax.while_loop(lambda carry: (carry.progress[0] < end) & (carry.progress[1] == 0), body, carry)


@lru_cache(maxsize=8)
def compiled(layout: Layout) -> Any:
    """Return :func:`tick` of this layout, compiled when it is first called."""
    import jax

    return jax.jit(partial(tick, layout), compiler_options={"xla_cpu_multi_thread_eigen": False})
