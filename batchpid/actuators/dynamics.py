r"""From the effort asked for to the effort delivered, and from the joint's state to its measurement.

Pure functions on (envs, joints), for NumPy and JAX. At each step, with the effort u of the controller, the joint's
position q and velocity v::

    y, y' = q(t - d_s), v(t - d_s)                          sensor delay
    y     = r rint(y / r)                                   resolution, of y' likewise
    m     = s u(t - d_c) + b                                command delay, strength, bias
    e     = m                                               off: lag
    e     = e' + (1 - exp(-dt / T)) (m - e')                lag, m within the envelope; exact for a constant m
    e     = min(max(e, low(v)), high(v))                    envelope

A prime at e is the value of the step before. Friction and armature are the simulator's: see :mod:`batchpid.friction`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from batchpid.actuators import delay
from batchpid.actuators.envelope import narrow
from batchpid.actuators.model import Actuators
from batchpid.actuators.state import ActuatorState
from batchpid.display import array_summary
from batchpid.elementwise import TURN, namespace


class Coefficients(NamedTuple):
    """:class:`Actuators` at one time step, in the symbols of :mod:`batchpid.actuators.dynamics`; None is off."""

    command: delay.Delay | None = None
    sensor: delay.Delay | None = None
    intake: Any = None
    """1 - exp(-dt / T)."""
    strength: Any = None
    bias: Any = None
    stall: Any = None
    """S."""
    slope: Any = None
    """S / v0."""
    limit: Any = None
    """L."""
    position_resolution: Any = None
    velocity_resolution: Any = None
    turns: Any = None
    """1 / (2 pi) on continuous joints, 0 elsewhere."""

    def __repr__(self) -> str:
        return array_summary(self._replace(command=None, sensor=None), "envs", "joints")


def init(
    actuators: Actuators, qpos: Any, dt: float, *, qvel: Any = None, effort: Any = None, samples: int | None = None
) -> ActuatorState:
    """Return the state of actuators that have been at rest: with ``qpos`` measured and ``effort`` asked so far.

    Parameters
    ----------
    qpos, qvel, effort
        Position [rad or m], velocity and effort [N m or N] (envs, joints) so far; velocity and effort are 0 by default.
    dt
        Time step [s].
    samples
        Length of the histories, at least 2; None: as long as the delays need. Needed where delays are traced by JAX.

    Raises
    ------
    InvalidArgumentError
        A delay is traced and ``samples`` is missing, or a delay needs too many samples.
    """
    xp = namespace(*actuators, qpos)
    zeros = xp.zeros_like(qpos)
    asked = zeros if effort is None else zeros + effort
    velocity = zeros if qvel is None else zeros + qvel
    command = position = rate = None
    if actuators.command_delay is not None:
        command = delay.start(asked, samples or delay.samples_of("command_delay", actuators.command_delay, dt))
    if actuators.sensor_delay is not None:
        count = samples or delay.samples_of("sensor_delay", actuators.sensor_delay, dt)
        position, rate = delay.start(zeros + qpos, count), delay.start(velocity, count)
    state = ActuatorState(command=command, position=position, velocity=rate)
    if actuators.lag is None:
        return state
    k = discretise(actuators, state, dt)
    return state._replace(effort=narrow(_motor(k, asked), k.stall, k.slope, k.limit, velocity, xp) + zeros)


def discretise(actuators: Actuators, state: ActuatorState, dt: Any) -> Coefficients:
    """Return the coefficients at ``dt`` [s], for :func:`advance_effort` and :func:`advance_measurement`."""
    xp = namespace(*actuators)
    a = actuators
    return Coefficients(
        command=None if a.command_delay is None else delay.discretise(a.command_delay, dt, state.command),
        sensor=None if a.sensor_delay is None else delay.discretise(a.sensor_delay, dt, state.position),
        intake=None if a.lag is None else -xp.expm1(-dt / xp.where(a.lag > 0, a.lag, 1e-3 * dt)),
        strength=a.strength,
        bias=a.bias,
        stall=a.saturation_effort,
        slope=None if a.saturation_effort is None else _slope(a.saturation_effort, a.no_load_speed, xp),
        limit=a.effort_limit,
        position_resolution=a.position_resolution,
        velocity_resolution=a.velocity_resolution,
        turns=None if a.continuous is None else a.continuous / TURN,
    )


def deliver(
    actuators: Actuators, state: ActuatorState, effort: Any, qpos: Any, qvel: Any, dt: Any
) -> tuple[ActuatorState, Any]:
    """Advance the motors by ``dt`` seconds; return ``(state, effort)``, the effort delivered [N m or N].

    ``effort`` is that asked for [N m or N], ``qpos`` and ``qvel`` are the joints' true positions [rad or m] and
    velocities, all (envs, joints); none is written to.
    """
    return advance_effort(discretise(actuators, state, dt), state, effort, qpos, qvel)


def measure(
    actuators: Actuators, state: ActuatorState, qpos: Any, qvel: Any, dt: Any
) -> tuple[ActuatorState, Any, Any]:
    """Advance the sensors by ``dt`` seconds; return ``(state, qpos, qvel)`` as measured (envs, joints).

    ``qpos`` and ``qvel`` are the true positions [rad or m] and velocities; none is written to.
    """
    return advance_measurement(discretise(actuators, state, dt), state, qpos, qvel)


def advance_effort(
    k: Coefficients, state: ActuatorState, effort: Any, qpos: Any, qvel: Any
) -> tuple[ActuatorState, Any]:
    """Advance the motors with given coefficients, for loops with constant actuators; otherwise as :func:`deliver`."""
    xp = namespace(effort, qvel, *k)
    if k.command is not None:
        history = delay.push(state.command, effort, xp)
        state, effort = state._replace(command=history), delay.read(history, k.command, None, xp)
    motor = narrow(_motor(k, effort), k.stall, k.slope, k.limit, qvel, xp)
    if k.intake is not None:
        motor = narrow(state.effort + k.intake * (motor - state.effort), k.stall, k.slope, k.limit, qvel, xp)
        state = state._replace(effort=motor)
    return state, motor


def advance_measurement(k: Coefficients, state: ActuatorState, qpos: Any, qvel: Any) -> tuple[ActuatorState, Any, Any]:
    """Advance the sensors with given coefficients, for loops with constant actuators; otherwise as :func:`measure`."""
    xp = namespace(qpos, qvel, *k)
    if k.sensor is not None:
        positions, velocities = delay.push(state.position, qpos, xp), delay.push(state.velocity, qvel, xp)
        state = state._replace(position=positions, velocity=velocities)
        qpos, qvel = delay.read(positions, k.sensor, k.turns, xp), delay.read(velocities, k.sensor, None, xp)
    return state, _quantised(qpos, k.position_resolution, xp), _quantised(qvel, k.velocity_resolution, xp)


def reset(state: ActuatorState, fresh: ActuatorState, mask: Any) -> ActuatorState:
    """Return ``state`` with the envs of ``mask`` (envs,) bool as in ``fresh``, which :func:`init` returns."""
    xp = namespace(*state, mask)
    chosen = xp.asarray(mask)

    def choose(new: Any, old: Any) -> Any:
        return None if old is None else xp.where(chosen.reshape(-1, *[1] * (old.ndim - 1)), new, old)

    return ActuatorState(*(choose(new, old) for new, old in zip(fresh, state, strict=True)))


def _slope(stall: Any, speed: Any, xp: Any) -> Any:
    """Return S / v0, 0 where there is no envelope."""
    finite = xp.isfinite(stall)
    return xp.where(finite, xp.where(finite, stall, 0.0) / speed, 0.0)


def _motor(k: Coefficients, effort: Any) -> Any:
    """Return s u + b."""
    effort = effort if k.strength is None else k.strength * effort
    return effort if k.bias is None else effort + k.bias


def _quantised(value: Any, resolution: Any, xp: Any) -> Any:
    """Return r rint(x / r), x where r is 0."""
    if resolution is None:
        return value
    step = xp.where(resolution > 0, resolution, 1.0)
    return xp.where(resolution > 0, step * xp.rint(value / step), value)
