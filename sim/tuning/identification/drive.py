"""Control of the robot in a log, and its PID law along simulated and measured motions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid.choices import PerMassMatrix
from batchpid.computed_torque import advance_with_mass_matrix, per_inertia

Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class Drive:
    """Control of the robot in a log."""

    timestep: float
    """Time step of the simulation [s]."""
    params: bp.PIDParams | None
    """Params of the PID law, of the logged joints; None for a log of efforts."""
    compensate: str
    """"gravity+coriolis", "gravity" or "none"."""
    through: bool = False
    """True if the compensation passes through the motors, with their strength and delay."""
    knows_payload: bool = False
    """True if the compensation is that of the robot with its payload."""
    noisy: bool = False
    """True if the law is given the positions of the log, with their noise, False if it is given those without."""
    substeps: int = 1
    """Sim steps of a step of the law, whose effort holds meanwhile."""
    measured_rate: bool = False
    """True if the law is given the joint velocity, False if it takes differences of positions."""


class Law:
    """PID law of many candidates."""

    def __init__(self, drive: Drive, qpos: Float64, qvel: Float64) -> None:
        params = drive.params
        assert params is not None
        self._params, self._measured = params, drive.measured_rate
        self._k = bp.discretise(params, drive.timestep * drive.substeps, len(qpos))
        self._state = bp.init(params, qpos)

    def effort(
        self, setpoint: Float64, qpos: Float64, qvel: Float64, matrix: Float64, feedforward: Float64 | None
    ) -> Float64:
        """Advance the law by a step and return the efforts (n, joints)."""
        units = self._params.gain_units
        rate = qvel if self._measured else None
        if isinstance(units, PerMassMatrix):
            new = advance_with_mass_matrix(self._k, self._state, setpoint, qpos, matrix, rate, None, feedforward)
        else:
            k = self._k if units is None else per_inertia(self._k, np.diagonal(matrix, axis1=1, axis2=2))
            new = bp.advance(k, self._state, setpoint, qpos, rate, None, feedforward)
        self._state, effort = new[:2]
        return np.asarray(effort)
