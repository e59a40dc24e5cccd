"""Inputs and results of the stages of a sim step."""

from __future__ import annotations

from collections.abc import Callable
from itertools import repeat
from operator import is_not
from typing import Any, NamedTuple

import numpy as np

from batchpid.arrays.array_types import Array, Pytree, T
from batchpid.arrays.elementwise import namespace


class Command(NamedTuple):
    """Command of one tick, (envs, ...), or of several, (ticks, envs, ...).

    A missing array is None in the calling process, and 0 in a loop. A loop passes rates on only where
    some are given.
    """

    setpoint: Array
    """(envs, size), as :attr:`batchpid.sim.RunnerOptions.command` describes it: for joints (envs,
    dof) [rad or m].
    """
    setpoint_rate: Array = None
    """Rate of the setpoint, per second (envs, size)."""
    setpoint_acceleration: Array = None
    """Acceleration of the setpoint, per second squared (envs, size)."""
    feedforward: Array = None
    """Joint effort added before saturation (envs, dof) [N m or N]."""

    def map(self, function: Callable[[Array], Array]) -> Command:
        """Return a command with ``function`` applied to each array that is given."""
        return Command(*[None if rows is None else function(rows) for rows in self])

    @property
    def given(self) -> tuple[bool, ...]:
        """Which arrays are given."""
        return tuple(map(is_not, self, repeat(None)))

    def resting(self) -> Command:
        """Return the command without the rates of its setpoint."""
        return self._replace(setpoint_rate=None, setpoint_acceleration=None)


class Measured(NamedTuple):
    """Reading of the robots before a sim step, arrays (M, dof)."""

    qpos: Array
    qvel: Array
    passive: Array
    """Efforts that cancel gravity, and Coriolis and centrifugal forces. Without compensation 0, and
    None at the start of an env.
    """


class Step(NamedTuple):
    """Place of a sim step in its tick."""

    index: Array  # type: ignore[assignment]  # a field hides tuple.index
    """Sim steps of the tick before this one."""
    end: Array
    """Sim steps of the tick."""
    left: Array = 0.0
    """Time from the moment of the law's setpoint to the end of the tick [s]."""


class Outputs(NamedTuple):
    """Results of a sim step, arrays (M, dof)."""

    qf: Array = None
    """Effort to apply to the joints in the next step of the engine [N m or N]."""
    motor: Array = None
    """Effort of the motors [N m or N]."""
    saturated: Array = None
    """Joints whose effort was limited; None under control "drive"."""
    guarded: Array = None
    """Setpoints that the guard changed; None without guard."""
    returned: Array = None
    """Effort that the caller's own controller returned; None for other controls."""
    target: Array = None
    """Position target of the engine's drives [rad or m]; None without drives."""
    target_rate: Array = None

    @property
    def shown(self) -> dict[str, Array]:
        """Quantities of an observation, by name."""
        return {"effort": self.motor, "saturated": self.saturated, "guarded": self.guarded}


def when(due: Array, function: Callable[[], T], otherwise: T) -> T:
    """Return ``function()`` if ``due``, a bool or an array, has a True entry; else
    ``otherwise``.
    """
    if np.any(due):
        return function()
    return otherwise


class Model(NamedTuple):
    """Functions of the robots that stages call; their results are the same in every executor."""

    mass_matrix: Any = None
    """qpos (M, dof) -> mass matrix of the description (M, dof, dof), as the law knows it."""
    joint_mass_matrix: Any = None
    """qpos -> effective mass matrix of the joints, armature of the motors included."""
    passive_force: Any = None
    """qpos, qvel -> passive force of the description (M, dof)."""
    load: Any = None
    """() -> effort that holds the joints where they are (M, dof)."""
    refresh: Any = None
    """state of the friction model, qpos -> the state with its inertia there; None: by
    :attr:`joint_mass_matrix`.
    """
    when: Callable[[Any, Callable[[], Any], Any], Any] = when
    """:func:`when`, or a conditional of JAX."""
    envs: Array = None
    """Number of each env (M,)."""
    episode: Array = 0
    """Number of its episode."""


class Values(NamedTuple):
    """Values that the stages of a sim step read and replace; arrays (M, dof)."""

    command: Command
    """Without rates where joint setpoints do not move within a tick."""
    measured: Measured
    """Reading of the robots before the step."""
    seen: Measured
    """The reading as the sensors measure it."""
    timestep: Any = None
    """[s]"""
    step: Step = Step(0, 1)
    model: Model = Model()
    last: Outputs = Outputs()
    """``qf`` and ``motor`` of the sim step before, 0 at a start, where a stage of the caller's may
    read them.
    """
    noise: Pytree = None
    """Noise of the sensors in this step; None to draw it."""
    inertia: tuple[Array, Array] = (None, None)
    """Factors of the friction model, from the inertias that the joints show."""
    matrix: Array = None
    """Mass matrix for the law (M, dof, dof)."""
    forward: Array = None
    """Passive force, feedforward and modelled friction, for the leaders [N m or N]."""
    limits: tuple[Array, Array] = (None, None)
    """Least and largest effort that the motors deliver; None for no limit."""
    limited: Array = None
    """Joints whose effort the caller's own controller has limited; None if it does not report it."""
    outputs: Outputs = Outputs()

    def within(self, low: Array, high: Array) -> Values:
        """Return these values with the limits of efforts within ``low`` and ``high`` [N m or N]."""
        least, most = self.limits
        xp = namespace(low, high, least, most)
        if least is not None:
            low = xp.maximum(low, least)
        if most is not None:
            high = xp.minimum(high, most)
        return self._replace(limits=(low, high))

    def told(self, **outputs: Array) -> Values:
        """Return these values with other outputs."""
        return self._replace(outputs=self.outputs._replace(**outputs))


Told = tuple[Any, Values]
"""State of a stage, and the values for the stages after it."""
