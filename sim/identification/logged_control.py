"""Control of the robot in a log, and its PID law along simulated and measured motions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import batchpid as bp
from batchpid.arrays.array_types import Float64
from batchpid.sim.loop.pid_law import PIDLaw


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
    """True if the compensation includes the payload."""
    noisy: bool = False
    """True if the law is given the logged positions with their noise, False if without."""
    substeps: int = 1
    """Sim steps in one step of the law, during which its effort is constant."""
    measured_rate: bool = False
    """True if the law is given the joint velocity, False if it takes differences of positions."""

    @property
    def compensation(self) -> tuple[str, bool, bool]:
        """Hypothesis about the compensation."""
        return self.compensate, self.through, self.knows_payload

    @property
    def assumptions(self) -> dict[str, str | bool]:
        """Hypotheses about compensation and law, as plain values."""
        return {
            "compensation": self.compensate,
            "through_the_motors": self.through,
            "knows_payload": self.knows_payload,
            "noise_in_the_law": self.noisy,
            "measured_rate": self.measured_rate,
        }


class Law:
    """PID law of many candidates."""

    def __init__(self, drive: Drive, qpos: Float64, qvel: Float64) -> None:
        params = drive.params
        assert params is not None
        self._law = PIDLaw.of(params)._replace(measures_rate=drive.measured_rate)
        params = params._replace(measurement_rate=None)  # the log's loop decides, not the params
        self._k = bp.discretise(params, drive.timestep * drive.substeps, len(qpos))
        self._state = bp.init(params, qpos)

    def effort(
        self, setpoint: Float64, qpos: Float64, qvel: Float64, matrix: Float64, feedforward: Float64 | None
    ) -> Float64:
        """Advance the law by a step and return the efforts (n, joints)."""
        given = matrix if self._law.whole else np.diagonal(matrix, axis1=1, axis2=2)
        self._state, effort, _ = self._law.advance(
            self._k, self._state, (setpoint, None, None), qpos, qvel, feedforward, given
        )
        return np.asarray(effort)
