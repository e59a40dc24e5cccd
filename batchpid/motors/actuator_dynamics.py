r"""From the commanded effort to the delivered effort, and from the joint's state to its
measurement.

Pure functions on (envs, joints), or (joints,) for one robot, such as under ``jax.vmap``, for NumPy
and JAX. At each step, with the joint's position q and
velocity v, and the effort u that the controller asks for::

    x      = q + min(max(x' - q, -B/2), B/2)               backlash: the sensor is dragged along
    v_x    = v, 0 within the play
    y, v_y = x(t - d_s), v_x(t - d_s)                      sensor delay
    y      = r rint((y + o + sigma z) / r)                 offset, noise, resolution; of v_y noise alone

    m      = s u(t - d_c) + b                              command delay, strength, bias
    e      = min(max(m, low(v)), high(v))                  envelope: batchpid.motors.actuators
    e      = e' + (1 - exp(-dt / T)) (e - e')              lag, again within the envelope; exact for a constant e

A command u is delivered unclipped, where nothing is late, if (low - b) / s <= u <= (high - b) / s:
:func:`command_limits`.

A prime is the value of the step before. The play is the backlash hysteresis (G. Tao and P.
Kokotovic, Adaptive Control of Systems with Actuator and Sensor Nonlinearities, Wiley, 1996, chapter
2). Friction and armature are the simulator's: see :mod:`batchpid.motors.friction`.

A new effect is, in :mod:`batchpid.motors.actuators`, a field of :class:`Actuators` with its
``Field``, and an entry in the docstring of ``make_actuators``; ``_check_together`` has conditions on
several fields. Files, randomizations and the table of docs/actuators.md (``python docs/tables.py``)
take it from there; each export has it, or lists it as a difference. Here it is a field of
:class:`MotorCoefficients`, a value in :func:`discretise`, a start in :func:`init` if it has a state,
and a term in :func:`advance_effort` (motor) or :func:`advance_measurement` (sensor). An effect that changes the
limits of commands has a term in ``command_envelope``, too. Terms may use the operations of
:mod:`batchpid.native.extensions` only (no sin, exp or pow), so that they also run in JAX and in
native code; coefficients may use any.

An effect on the joint's side (friction, armature) is in ``JOINT_SIDE`` and, if it acts on drives,
``DRIVEN`` of :mod:`batchpid.motors`; ``added_friction`` of batchpid/sim/engine/scene_spec.py or
``EnginePack._add_joints`` adds it to the joint. Joint-side effects and ``bias`` leave followers out,
in ``fit_actuators`` (batchpid/sim/robot/robot_options.py) and ``LEADER_FIELDS``
(batchpid/sim/randomization/randomization.py).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from batchpid.arrays.array_types import Array, ArrayModule
from batchpid.arrays.elementwise import TURN, clip, in_dtype_of, namespace, push_history, wrap
from batchpid.arrays.trees import mapped
from batchpid.checks import check_time_step
from batchpid.motors import delay
from batchpid.motors import sensor_noise as noise
from batchpid.motors.actuators import (
    Actuators,
    ActuatorState,
    Envelope,
    command_envelope,
    envelope,
    limits,
)

_ONE = np.uint32(1)


class MotorCoefficients(NamedTuple):
    """:class:`Actuators` at one time step, in the symbols of
    :mod:`batchpid.motors.actuator_dynamics`; None is off.
    """

    command: delay.Delay | None = None
    sensor: delay.Delay | None = None
    envelope: Envelope = Envelope()
    commands: Envelope = Envelope()
    """Envelope of the commands that the motor delivers unclipped."""
    intake: Array = None
    """1 - exp(-dt / T)."""
    strength: Array = None
    bias: Array = None
    play: Array = None
    """B / 2."""
    position_offset: Array = None
    """o."""
    position_resolution: Array = None
    position_noise: Array = None
    velocity_noise: Array = None
    turns: Array = None
    """1 / (2 pi) on continuous joints, 0 elsewhere."""


def init(
    actuators: Actuators,
    qpos: Array,
    dt: float,
    *,
    qvel: Array = None,
    effort: Array = None,
    envs: Array = None,
    episode: Array = 0,
    samples: int | None = None,
) -> ActuatorState:
    """Return the state of actuators that have been at rest, at the measured positions ``qpos`` and
    the commanded efforts ``effort``.

    Parameters
    ----------
    qpos, qvel, effort
        Position [rad or m], velocity and effort [N m or N] (envs, joints) or (joints,) so far;
        velocity and effort are 0 by default.
    dt
        Time step [s].
    envs, episode
        Number of each env, default 0, 1, ..., and of its episode (envs,): the noise depends on
        both. One robot (joints,) is number 0, so pass its number under ``jax.vmap``.
    samples
        Length of the histories, at least 2; None: as long as ``max_delay`` needs, which is
        floor(max_delay / dt) + 2. Needed where that is traced by JAX, as in actuators that are
        arguments of ``jax.jit``. A longer delay returns the oldest sample.

    Raises
    ------
    InvalidArgumentError
        dt is not positive, or above 1 s; ``max_delay`` is traced and ``samples`` is missing, or it
        needs too many.
    """
    check_time_step(dt)
    qpos, qvel, effort = in_dtype_of(actuators, qpos, qvel, effort)
    actuators = actuators.for_rank(qpos.ndim)
    xp = namespace(*actuators, qpos)
    zeros = xp.zeros_like(qpos)
    position = zeros + qpos
    velocity = zeros if qvel is None else zeros + qvel
    requested = zeros if effort is None else zeros + effort
    # What no effect needs is None, and costs nothing.
    command = positions = velocities = encoder = key = step = None
    # Histories are as long as the longest delay.
    if actuators.max_delay is not None:
        if samples is None:
            samples = delay.samples_of(actuators.max_delay, dt)
        if actuators.command_delay is not None:
            command = delay.start(requested, samples)
        if actuators.sensor_delay is not None:
            positions, velocities = (delay.start(rows, samples) for rows in (position, velocity))
    if actuators.backlash is not None:
        encoder = position
    if actuators.seed is not None:
        leading = zeros.shape[:-1]
        numbers = xp.arange(math.prod(leading)).reshape(leading) if envs is None else envs
        episodes = xp.broadcast_to(xp.asarray(episode), leading)
        key = noise.keys(actuators.seed, numbers, episodes, xp)
        step = xp.zeros(leading, xp.uint32)
    state = ActuatorState(
        command,
        None,
        positions,
        velocities,
        encoder,
        key,
        step,
    )
    if actuators.lag is None:
        return state
    k = discretise(actuators, state, dt)
    return state._replace(
        effort=clip(_motor(k, requested), *limits(k.envelope, velocity), xp) + zeros
    )


def discretise(
    actuators: Actuators,
    state: ActuatorState,
    dt: Array,
    num_envs: int | None = None,
) -> MotorCoefficients:
    """Return the coefficients at ``dt`` [s], for :func:`advance_effort` and
    :func:`advance_measurement`; those of arrays (joints,) are of ``actuators.for_rank(1)``.

    With ``num_envs`` each is spread to (num_envs, joints), which lets NumPy step small batches
    faster. Raises InvalidArgumentError if dt is a number that is not positive, or above 1 s.
    """
    check_time_step(dt)
    a = actuators
    xp = namespace(*actuators)
    command, sensor = [
        None if seconds is None else delay.discretise(seconds, dt, history.shape[-2])
        for seconds, history in (
            (a.command_delay, state.command),
            (a.sensor_delay, state.position),
        )
    ]
    k = MotorCoefficients(
        command=command,
        sensor=sensor,
        envelope=envelope(a),
        commands=command_envelope(a),
        intake=None if a.lag is None else -xp.expm1(-dt / xp.maximum(a.lag, 1e-3 * dt)),
        strength=a.strength,
        bias=a.bias,
        play=None if a.backlash is None else 0.5 * a.backlash,
        position_offset=a.position_offset,
        position_resolution=_step(a.position_resolution, xp),
        position_noise=a.position_noise,
        velocity_noise=a.velocity_noise,
        turns=None if a.continuous is None else a.continuous / TURN,
    )
    if num_envs is None:
        return k

    def spread(leaf: Array) -> Array:
        return xp.broadcast_to(leaf, (num_envs, leaf.shape[-1])).copy()

    wide: MotorCoefficients = mapped(spread, k)
    return wide


def _motor(k: MotorCoefficients, effort: Array) -> Array:
    """Return s u + b."""
    if k.strength is not None:
        effort = k.strength * effort
    if k.bias is None:
        return effort
    return effort + k.bias


def command_limits(k: MotorCoefficients, qvel: Array) -> tuple[Array, Array]:
    """Return the smallest and the largest commanded effort that the motor does not clip at
    ``qvel``.

    They are those for the saturation and anti-windup of a law. Delay and lag do not enter: they are
    dynamics, and as a difference from the effort asked for they would leak into the integral. None:
    no limit.
    """
    return limits(k.commands, qvel)


def advance_effort(
    k: MotorCoefficients,
    state: ActuatorState,
    effort: Array,
    qvel: Array,
) -> tuple[ActuatorState, Array]:
    """Advance the motors by a time step; return ``(state, effort)``, the effort delivered [N m or
    N].

    ``effort`` is that asked for [N m or N], ``qvel`` the joints' true velocities, both (envs,
    joints) or (joints,); none is written to.
    """
    xp = namespace(effort, qvel)
    # Delay, motor, envelope and lag, in the order in which a command passes them.
    command, behind = state.command, state.effort
    if k.command is not None:
        command = push_history(command, effort)
        effort = delay.read(command, k.command, None, xp)
    low, high = limits(k.envelope, qvel)
    motor = clip(_motor(k, effort), low, high, xp)
    if k.intake is not None:
        # The lagged effort stays within the envelope, too.
        motor = behind = clip(behind + k.intake * (motor - behind), low, high, xp)
    return ActuatorState(command, behind, *state[2:]), motor


def advance_measurement(
    k: MotorCoefficients,
    state: ActuatorState,
    qpos: Array,
    qvel: Array,
    drawn: tuple[Array, Array] | None = None,
) -> tuple[ActuatorState, Array, Array]:
    """Advance the sensors by a time step; return ``(state, qpos, qvel)`` as measured.

    ``qpos`` and ``qvel`` are the true positions [rad or m] and velocities (envs, joints) or
    (joints,); none is written to. ``drawn`` is the :func:`measurement_noise` at ``state.step``, if it is known already.
    """
    xp = namespace(qpos, qvel)
    command, effort, positions, velocities, encoder, key, step = state
    # Play, delay, encoder: in the order in which a signal passes them.
    if k.play is not None:
        # The encoder moves once the play is used up, and not before.
        behind = wrap(encoder - qpos, k.turns, xp)
        offset = clip(behind, -k.play, k.play, xp)
        qpos = encoder = qpos + offset
        qvel = qvel * (offset != behind).astype(qvel.dtype)
    if k.sensor is not None:
        positions, velocities = push_history(positions, qpos), push_history(velocities, qvel)
        qpos = delay.read(positions, k.sensor, k.turns, xp)
        qvel = delay.read(velocities, k.sensor, None, xp)
    if k.position_offset is not None:
        qpos = qpos + k.position_offset
    if key is not None:
        if drawn is None:
            drawn = measurement_noise(k, key, step, qpos, xp)
        step = step + _ONE
    # Native programs have the noise drawn, and no key.
    if drawn is not None:
        position, velocity = drawn
        qpos = qpos if position is None else qpos + position
        qvel = qvel if velocity is None else qvel + velocity
    # Resolution comes last: noise and offset are rounded, as in an encoder.
    if k.position_resolution is not None:
        qpos = xp.rint(qpos / k.position_resolution) * k.position_resolution
    state = ActuatorState(command, effort, positions, velocities, encoder, key, step)
    return state, qpos, qvel


def measurement_noise(
    k: MotorCoefficients,
    key: Array,
    step: Array,
    like: Array,
    xp: ArrayModule,
) -> tuple[Array, Array]:
    """Return the noise of positions and of velocities (..., envs, joints) at ``step`` (..., envs);
    None for none.

    ``key`` is the key of the state, and ``like`` an array (envs, joints) of the same dtype.
    """
    both = noise.normals(key, step, like.shape[-1], like.dtype, xp)
    deviations = k.position_noise, k.velocity_noise
    position, velocity = (
        None if sigma is None else sigma * z for sigma, z in zip(deviations, both, strict=True)
    )
    return position, velocity


def _step(resolution: Array, xp: ArrayModule) -> Array:
    """Return the step of a sensor; 2^-60, which is below the last bit that matters, without a
    resolution.
    """
    if resolution is None:
        return None
    return xp.where(resolution > 0, resolution, 2.0**-60)
