"""Values of a sim step: state, command and reading of the control, its constants, the law of control
"pid", and the functions of an executor.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

import batchpid as bp
from batchpid.arrays.array_types import Array, Pytree, T
from batchpid.arrays.elementwise import clip, namespace
from batchpid.law.coefficients import Coefficients
from batchpid.law.computed_torque import advance_with_mass_matrix
from batchpid.motors.coupling import Coupling
from batchpid.motors.friction import Friction, FrictionState
from batchpid.sim.loop.arrays import Command

MASS_MATRIX_STEPS = 4
"""Sim steps for which a mass matrix is kept within a tick.

The implicit law takes a fresh one in each: in setpoint steps at w dt = 1 panda diverges with a
matrix kept for 4 steps, at w dt = 3 with one kept for 2.
"""


class PIDLaw(NamedTuple):
    """Variants of the law that the params select."""

    uses_mass_matrix: bool
    """Gains per mass matrix: u = M a."""
    measures_rate: bool
    """The derivative term takes the measured velocity."""
    implicit: bool
    """P, I and D act on the end of the step."""

    @classmethod
    def of(cls, params: bp.PIDParams) -> PIDLaw:
        """Return the law that ``params`` select."""
        choices = params.gain_units, params.measurement_rate, params.discretization
        return cls(*(choice is not None for choice in choices))

    @property
    def matrix_steps(self) -> int:
        """Sim steps for which a mass matrix is kept within a tick."""
        if self.implicit:
            return 1
        return MASS_MATRIX_STEPS

    def advance(
        self,
        k: Coefficients,
        state: bp.PIDState,
        command: tuple[Array, Array, Array],
        qpos: Array,
        qvel: Array,
        feedforward: Array,
        matrix: Array = None,
        viscous: Array = None,
        low: Array = None,
        high: Array = None,
    ) -> tuple[bp.PIDState, Array, Array]:
        """Return the new state, the effort, and the mask of saturated joints.

        Parameters
        ----------
        command
            Setpoint, its rate (None: not given), and its acceleration.
        matrix
            M + dt B (envs, dof, dof) for gains per mass matrix.
        viscous
            B q', where the whole matrix is used: the engine integrates it implicitly, (M + dt B)
            (v+ - v) = dt (u - B v), so that u = (M + dt B) a + B v gives exactly v+ = v + dt a.
        low, high
            Least and largest effort of the motors (envs, dof); None for no limit. Saturation and
            anti-windup use them after clipping to the limits of the params.
        """
        if low is not None:
            xp = namespace(low, high)
            low, high = (clip(end, k.effort_min, k.effort_max, xp) for end in (low, high))
            k = k._replace(effort_min=low, effort_max=high)
        if viscous is not None:
            feedforward = viscous + feedforward
        setpoint, setpoint_rate, acceleration = command
        rates = qvel if self.measures_rate else None, setpoint_rate
        if self.uses_mass_matrix:
            inputs = setpoint, qpos, matrix, *rates, acceleration, feedforward
            new, terms = advance_with_mass_matrix(k, state, *inputs)
        else:  # accelerations are for gains per mass matrix only
            new, terms = bp.advance(k, state, setpoint, qpos, *rates, feedforward)
        return new, terms.effort, terms.effort != terms.unsaturated


class StepState(NamedTuple):
    """State of the control of M envs between sim steps; arrays have the envs as their first
    axis.
    """

    law: Pytree
    """:class:`batchpid.PIDState`, or the arrays of the caller's own controller by name."""
    friction: FrictionState = FrictionState()
    age: Array = None
    """Sim steps since the last update of the friction model's inertia (M,); None without Coulomb
    friction.
    """
    motors: Any = None
    """:class:`batchpid.motors.ActuatorState` of motors and sensors; None for ideal ones."""
    guard: Any = None
    """:class:`batchpid.motors.guard.GuardState`; None without guard."""
    matrix: Array = None
    """Mass matrix of the law (M, dof, dof). Each tick begins with a new one."""


class Measured(NamedTuple):
    """Reading of the robots before a sim step, arrays (M, dof)."""

    qpos: Array
    qvel: Array
    passive: Array
    """Efforts that cancel gravity, and Coriolis and centrifugal forces; 0 without compensation."""


class Step(NamedTuple):
    """Place of a sim step in its tick."""

    index: Array  # type: ignore[assignment]  # a field hides tuple.index
    """Sim steps of the tick before this one."""
    end: Array
    """Sim steps of the tick."""
    left: Array = 0.0
    """:meth:`Layout.left`: time from the moment of the law's setpoint to the end of the tick
    [s].
    """


class Outputs(NamedTuple):
    """Results of a sim step, arrays (M, dof)."""

    qf: Array = None
    """Effort to apply to the joints in the next step of the engine [N m or N]."""
    motor: Array = None
    """Effort of the motors."""
    saturated: Array = None
    """Joints whose effort was limited; None under control "drive"."""
    guarded: Array = None
    """Setpoints that the guard changed; None without guard."""
    returned: Array = None
    """Effort that the caller's own controller returned; None for other controls."""
    target: Array = None
    """Position target of the engine's drives [rad or m]; None without drives."""
    target_rate: Array = None


class Values(NamedTuple):
    """What the stages of a sim step read and replace."""

    state: StepState
    command: Command
    measured: Measured
    """Reading of the robots before the step."""
    step: Step
    seen: Measured
    """Reading as the sensors measure it. The stage "feedforward" replaces its passive force by the
    whole feedforward.
    """
    noise: Pytree = None
    """Noise of the sensors in this step, if it is drawn in advance."""
    limited: Array = None
    """Joints whose effort the caller's own controller has limited (M, dof); None if it does not
    report them.
    """
    outputs: Outputs = Outputs()


class ModelledFriction(NamedTuple):
    """Friction that the compensation cancels, arrays (dof,)."""

    friction: Array
    """[N m or N]"""
    band: Array
    """Half width of the band of small errors in which the compensation is reduced [rad or m]."""
    turns: Array
    """1 / (2 pi) on continuous joints, 0 elsewhere; None without such joints."""


class Constants(NamedTuple):
    """Arrays that stay the same for many ticks, (M, dof) or (1, dof); None where they are not
    needed.
    """

    timestep: float
    """[s]"""
    limits: tuple[Array, Array]
    """Least and largest effort of the params [N m or N]."""
    coupling: Coupling
    k: Any = None
    """:class:`batchpid.law.coefficients.Coefficients` of the PID law."""
    armature: Array = None
    """Armature of the motors that the law knows (dof,) [kg m^2 or kg]."""
    damping: Array = None
    """Viscous damping B that a law with the mass matrix compensates (dof,) [N m s/rad or N s/m]."""
    friction: Friction = Friction()
    drive: tuple[Array, Array] = (0.0, 0.0)
    """Damping and stiffness of the engine's drives [N m s/rad, N m/rad]."""
    modelled: ModelledFriction | None = None
    """Friction of the description and of the robot's actuators."""
    guard: Any = None
    """:class:`batchpid.Guard`"""
    motors: Any = None
    """:class:`batchpid.motors.MotorCoefficients` of motors and sensors."""
    driven: Coefficients | None = None
    """Coefficients of the integral that moves the targets of drives."""
    turns: Array = None
    """1 / (2 pi) on continuous joints with drives, 0 elsewhere; None without such joints."""


def when(due: Array, function: Callable[[], T], otherwise: T) -> T:
    """Return ``function()`` if ``due``, a bool or an array, has a True entry; else
    ``otherwise``.
    """
    if np.any(due):
        return function()
    return otherwise


class Model(NamedTuple):
    """Functions that an executor passes to the control step. Their results do not depend on the
    executor.
    """

    mass_matrix: Any = None
    """qpos (M, dof) -> mass matrix of the description (M, dof, dof), as the law knows it."""
    joint_mass_matrix: Any = None
    """qpos -> effective mass matrix of the joints, armature of the motors included."""
    refresh: Any = None
    """state of the friction model, qpos -> the state with its inertia there; None: by
    :attr:`joint_mass_matrix`.
    """
    passive_force: Any = None
    """qpos, qvel -> passive force of the description, for a measured state that differs from the
    joints' state.
    """
    when: Callable[[Any, Callable[[], Any], Any], Any] = when
    """:func:`when`, or a conditional of JAX."""
    controller: Any = None
    """Caller's own controller: (state, setpoint, qpos, qvel, feedforward, time to the end of the
    tick) -> (state, effort), and, if it limits efforts itself, the mask of joints with limited efforts.
    """
    noise: Any = None
    """coefficients and state of the sensors, qpos -> their noise, drawn in advance; None to draw it
    at each step.
    """


class Layout(NamedTuple):
    """Options of a control step that are not arrays; hashable."""

    control: str
    """"pid", "drive", "effort" or "custom"."""
    law: PIDLaw | None = None
    """Law of control "pid"."""
    measures: bool = False
    """Whether the law takes the joints' state from sensors."""
    model: Model = Model()
    moves: bool = False
    """Whether joint setpoints move within a tick, at a given rate."""
    gravity: bool = False
    coriolis: bool = False
    """Parts of the passive force that are compensated."""
    implicit: bool = False
    """Whether the law, or operational-space control, is implicit."""

    def left(self, index: Array, end: Array, timestep: Array) -> Array:
        """Return the time from the law's setpoint in sim step ``index`` to the end of a tick of
        ``end`` steps [s].

        The explicit law takes its setpoint at the beginning of the step, the implicit law and
        drives at the end.
        """
        return (end - index - self.late) * timestep

    @property
    def late(self) -> int:
        """1 if the law takes its setpoint at the end of a sim step, else 0."""
        return int(self.control == "drive" or self.implicit)


def half_way(
    qpos: Array,
    qvel: Array,
    steps: Array,
    timestep: float,
) -> Array:
    """Return the pose for the mass matrix of the next ``steps`` sim steps from ``qpos``: half way
    through them.

    The matrix error is then zero on average. With matrices 0.3 steps ahead, a jaco2 that is near
    upright, its axes nearly in line, leaves its path by 18 mrad.
    """
    return qpos + 0.5 * (steps - 1) * timestep * qvel
