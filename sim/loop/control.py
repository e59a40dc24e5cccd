"""Controls: joint efforts at each sim step, from the command of a tick and the state of the robots."""

from __future__ import annotations

from functools import partial
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid.coefficients import Coefficients
from batchpid.computed_torque import convert_integral
from batchpid.elementwise import clip
from sim.engine.engines import scene_dynamics
from sim.engine.protocol import DrivenPack, RobotModel
from sim.engine.scene_spec import SceneSpec
from sim.loop.arrays import Command
from sim.loop.law_program import LawProgram
from sim.loop.pid_law import MASS_MATRIX_STEPS, PIDLaw, acting_params, half_way
from sim.options import ControlMode
from sim.robot.actuators import KnownJoints
from sim.robot.mimics import coupling_of

Float64 = NDArray[np.float64]


class Plant(Protocol):
    """Robots under control; :class:`sim.engine.protocol.EnginePack` is one. Arrays are (M, dof)."""

    def read_qpos(self) -> Float64:
        """Return the joint positions [rad or m]."""

    def read_qvel(self) -> Float64:
        """Return the joint velocities [rad/s or m/s]."""


class Control:
    """Base of the controls, for the M envs of ``plant``; it owns the state of the law.

    Followers get no effort: their leaders move them, with the mass matrix and the passive force of both.

    Attributes
    ----------
    saturated
        Joints whose effort was limited in the last sim step of the last tick (M, dof).
    limits
        Least and largest effort to ask for that the motors do not clip, in addition to those of the params; None for
        no limit.
    drive
        Damping and stiffness of the engine's drives [N m s/rad, N m/rad].
    returned
        Last effort that the caller's own controller returned (M, dof); None for the other controls.
    """

    limits: tuple[Any, Any] = None, None
    drive: tuple[Any, Any] = 0.0, 0.0
    returned: NDArray[Any] | None = None

    def __init__(self, scene: SceneSpec, params: bp.PIDParams, plant: Plant, known: KnownJoints | None = None) -> None:
        self._scene, self._plant, self.params, self._known = scene, plant, params, known
        self._coupling = coupling_of(scene.joints)
        qpos = plant.read_qpos()
        self.saturated: NDArray[np.bool_] = np.zeros(qpos.shape, bool)
        self._state = bp.init(params, qpos)
        self._command, self._substeps = Command(qpos), 1
        self.set_params(params)

    def set_params(self, params: bp.PIDParams) -> None:
        """Change gains, limits and times; the state carries on."""
        self._state = self._state.matched_to(bp.init(params, self._plant.read_qpos()))
        self.params = params

    def reset(self, qpos: Float64, mask: NDArray[np.bool_]) -> None:
        """Reset the state of the envs of ``mask`` (M,), which are at ``qpos``."""
        self.saturated[mask] = False
        self._state = bp.reset(self.params, self._state, qpos, mask)

    def begin(self, command: Command, substeps: int) -> None:
        """Begin a tick of ``substeps`` sim steps under ``command``."""
        self._command, self._substeps = command, substeps

    def effort(
        self, qpos: Float64, feedforward: Float64 | None, step: int, qvel: Float64 | None = None
    ) -> Float64 | None:
        """Return the joint efforts of sim step ``step`` of the tick, ``feedforward`` included; None for zero.

        A ``qvel`` that is known need not be read.
        """
        raise NotImplementedError

    def saturate(self, effort: Float64) -> Float64:
        """Return ``effort`` within the limits of motors and params."""
        return clip(clip(effort, *self.limits, np), self.params.effort_min, self.params.effort_max, np)

    def read(self) -> dict[str, NDArray[Any]]:
        """Return the state of the law by name, for :meth:`write`."""
        return self._state.leaves()

    def write(self, state: dict[str, NDArray[Any]], saturated: NDArray[np.bool_]) -> None:
        """Set the state of the law, and :attr:`saturated`."""
        self._state, self.saturated = bp.PIDState(**state), saturated


class PIDControl(Control):
    """PID control: qf = sat(PID(setpoint, qpos) + feedforward).

    Gains per unit of inertia use a mass matrix that is kept for MASS_MATRIX_STEPS.

    Attributes
    ----------
    law
        The law as the params ask for it.
    coefficients
        Its coefficients (M, dof).
    damping
        Viscous damping of the joints that the law compensates (dof,) [N m s/rad or N s/m]; None for none.
    """

    _dynamics: RobotModel | None = None

    def set_params(self, params: bp.PIDParams) -> None:
        """Change gains, limits and times; the state carries on, with the integral in the unit of the new gains."""
        self.law = PIDLaw.of(params)
        damping = np.array([joint.damping for joint in self._scene.joints])
        if self._known is not None:
            damping = damping + self._known.viscous
        if self.law.whole != PIDLaw.of(self.params).whole:
            matrix = self._mass_matrix(self._plant.read_qpos(), damping)
            self._state = convert_integral(self._state, self.params, params, matrix)
        super().set_params(params)
        self.damping = damping if self.law.whole and damping.any() else None
        params = acting_params(params, self._coupling)
        self.coefficients = bp.discretise(params, self._scene.timestep, len(self.saturated))
        self._scale(self.coefficients)

    def effort(self, qpos: Float64, feedforward: Float64 | None, step: int, qvel: Float64 | None = None) -> Float64:
        """Advance the law by one sim step."""
        if self.params.gain_units is not None and step % MASS_MATRIX_STEPS == 0:
            self._update_mass_matrix(qpos, min(MASS_MATRIX_STEPS, self._substeps - step), qvel)
        if qvel is None and (self.law.measures_rate or self.damping is not None):
            qvel = self._plant.read_qvel()
        viscous = None
        if self.damping is not None and qvel is not None:
            viscous = self.damping * qvel
            if self._coupling is not None:
                viscous = self._coupling.efforts(viscous)
        matrix = self._matrix if self.law.whole else None
        last = step + 1 == self._substeps
        command = self._command.setpoint, self._command.setpoint_rate
        new = self._advance(self._scaled, command, qpos, qvel, feedforward, matrix, viscous, *self.limits, terms=last)
        if last:
            self.saturated = new[2]
        self._state, effort = new[:2]
        return effort

    def _scale(self, k: Coefficients) -> None:
        """Set the coefficients in use."""
        self._scaled, self._program = k, LawProgram(self.law, k) if LawProgram.available(k) else None

    def _advance(self, k: Coefficients, *inputs: Any, terms: bool) -> Any:
        """Return the new state and the effort, with ``terms`` also the mask of their saturation."""
        if self._program is not None:
            return self._program.advance(self._state, *inputs, terms=terms)
        new, effort, *shown = partial(self.law.advance, terms=terms)(k, self._state, *inputs)
        return new, effort, *(each.saturated for each in shown)

    def _update_mass_matrix(self, qpos: Float64, steps: int, qvel: Float64 | None) -> None:
        """Set the mass matrix, and the gains that depend on it, for so many sim steps from ``qpos``."""
        qvel = self._plant.read_qvel() if qvel is None else qvel
        self._matrix = self._mass_matrix(half_way(qpos, qvel, steps, self._scene.timestep), self.damping)
        if self.law.per_inertia:
            self._scale(self.law.scaled(self.coefficients, np.diagonal(self._matrix, axis1=1, axis2=2)))

    def _mass_matrix(self, qpos: Float64, damping: Float64 | None) -> Float64:
        """Return M + dt B (M, dof, dof), B being the viscous ``damping`` of the joints."""
        if self._dynamics is None:
            self._dynamics = scene_dynamics(self._scene)
        matrix = self._dynamics.mass_matrix(qpos)
        if self._known is not None:
            matrix = matrix + np.diag(self._known.armature)
        if damping is not None:
            matrix = matrix + self._scene.timestep * np.diag(damping)
        return matrix if self._coupling is None else self._coupling.mass_matrix(matrix)


class DriveControl(Control):
    """PhysX's internal drive with stiffness kp and damping kd; qf = feedforward.

    With ki the drive's target moves by the integral over kp (:func:`batchpid.drive_target`), so that the drive acts as
    a PID whose P and D the engine integrates implicitly.
    """

    _plant: DrivenPack

    def set_params(self, params: bp.PIDParams) -> None:
        """Change gains, limits and times; the state carries on."""
        super().set_params(params)
        self._integrates = params.ki is not None and bool(np.any(params.ki > 0))
        params = acting_params(params, self._coupling)
        damping = np.zeros_like(params.kp) if params.kd is None else params.kd
        limit = np.full_like(params.kp, np.inf) if params.effort_max is None else params.effort_max
        self._acting = params
        self._plant.write_drive(params.kp, damping, limit)
        self.drive = damping, params.kp

    def begin(self, command: Command, substeps: int) -> None:
        """Begin a tick: set the drives' targets."""
        super().begin(command, substeps)
        setpoint, rate, _ = command
        self._plant.write_drive_target(setpoint, np.zeros_like(setpoint) if rate is None else rate)

    def effort(
        self, qpos: Float64, feedforward: Float64 | None, step: int, qvel: Float64 | None = None
    ) -> Float64 | None:
        """Return ``feedforward``; move the drives' targets where there is an integral."""
        if self._integrates:
            setpoint, rate, _ = self._command
            rates = {"setpoint_rate": rate, "feedforward": feedforward}
            self._state, target = bp.drive_target(
                self._acting, self._state, setpoint, qpos, self._scene.timestep, **rates
            )
            self._plant.write_drive_target(target)
        return feedforward


class EffortControl(Control):
    """qf = sat(the caller's effort + feedforward); the setpoint is the effort.

    Efforts on followers act on their leaders.
    """

    def effort(
        self, qpos: Float64, feedforward: Float64 | None, step: int, qvel: Float64 | None = None
    ) -> Float64 | None:
        """Add and saturate."""
        setpoint = self._command.setpoint
        if self._coupling is not None:
            setpoint = self._coupling.efforts(setpoint)
        total = setpoint if feedforward is None else setpoint + feedforward
        effort = self.saturate(total)
        if step + 1 == self._substeps:
            self.saturated = effort != total
        return effort


CONTROLS: dict[ControlMode, type[Control]] = {"pid": PIDControl, "drive": DriveControl, "effort": EffortControl}
"""Class of each control."""
