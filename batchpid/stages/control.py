"""Control of a number of robots, from which their stages are made."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from batchpid.arrays.array_types import Array
from batchpid.law.params import PIDParams
from batchpid.motors.actuator_dynamics import MotorCoefficients, discretise, init
from batchpid.motors.actuators import ACTUATOR_FIELDS, Actuators
from batchpid.motors.coupling import Coupling
from batchpid.motors.friction import Friction
from batchpid.motors.guard import Guard
from batchpid.plan.plans import Plan


class Control(NamedTuple):
    """Control of ``envs`` robots; arrays (1 | envs, dof) or (dof,)."""

    timestep: float
    """[s]"""
    envs: int
    coupling: Coupling
    params: PIDParams
    mode: str = "pid"
    """"pid", "drive", "effort" or "custom"."""
    controller: Any = None
    """The caller's own controller in mode "custom"."""
    actuators: Actuators | None = None
    guard: Guard | None = None
    plan: Plan | None = None
    friction: Friction = Friction()
    """Friction and damping of the joints, simulated here."""
    gravity: bool = False
    coriolis: bool = False
    """Parts of the passive force that are compensated."""
    powered: Array = None
    """1.0 for joints with a motor, where forces are compensated, else 0.0 (dof,); None: all."""
    modelled: Array = None
    """Friction that the law compensates (dof,) [N m or N]; None for none."""
    band: Array = None
    """Half width of the band of small errors in which this compensation is reduced [rad or m]."""
    turns: Array = None
    """1 / (2 pi) on continuous joints, 0 elsewhere; None without such joints."""
    armature: Array = None
    """Armature of the motors that a law with the mass matrix knows (dof,) [kg m^2 or kg]."""
    damping: Array = None
    """Viscous damping that such a law knows (dof,) [N m s/rad or N s/m]."""
    further: tuple[Any, ...] = ()
    """Stages of the caller's, each with ``after``, the name of the stage before it."""

    @property
    def measures(self) -> bool:
        """Whether the law takes the joints' state from sensors."""
        return self.actuators is not None and self.actuators.measures

    @property
    def delivers(self) -> bool:
        """Whether motors deliver other efforts than the law asks for."""
        return self.actuators is not None and self.actuators.delivers

    @property
    def has_motors(self) -> bool:
        """Whether the actuators have an effect on efforts or measurements."""
        return self.measures or self.delivers

    def side(self, fields: Mapping[str, Any]) -> tuple[Actuators, MotorCoefficients]:
        """Return the actuators with the effects ``fields`` alone, and their coefficients."""
        assert self.actuators is not None
        others = ACTUATOR_FIELDS.keys() - fields.keys()
        half = self.actuators._replace(**dict.fromkeys(others))
        if not half.measures:
            half = half._replace(seed=None)
        # Coefficients of delays need the length of the histories.
        rows = np.zeros((self.envs, len(self.coupling.leader)))
        state = init(half, rows, self.timestep)
        return half, discretise(half, state, self.timestep, self.envs)

    @property
    def uses_matrix(self) -> bool:
        """Whether the law has gains per mass matrix."""
        return self.mode == "pid" and self.params.gain_units is not None

    @property
    def late(self) -> bool:
        """Whether the law takes its setpoint at the end of a sim step: an implicit one, and
        drives.
        """
        if self.mode == "custom":
            return bool(self.controller.implicit)
        return self.mode == "drive" or (
            self.mode == "pid" and self.params.discretization is not None
        )

    def left(self, index: Array, end: Array) -> Array:
        """Return the time from the law's setpoint in sim step ``index`` to the end of a tick of
        ``end`` steps [s].
        """
        return (end - index - int(self.late)) * self.timestep

    @property
    def gains(self) -> PIDParams:
        """The params with zero gains for followers, which move with their leaders."""
        gains = {name: getattr(self.params, name) for name in ("kp", "ki", "kd")}
        leaders = {
            name: self.coupling.of_independent(gain)
            for name, gain in gains.items()
            if gain is not None
        }
        return self.params._replace(**leaders)

    @property
    def drive(self) -> tuple[Array, Array]:
        """Damping and stiffness of the engine's drives [N m s/rad, N m/rad]; 0 without drives."""
        if self.mode != "drive":
            return 0.0, 0.0
        gains = self.gains
        return 0.0 * gains.kp if gains.kd is None else gains.kd, gains.kp
