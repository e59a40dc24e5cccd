"""What effort a tick's commands ask for, at each of its sim steps: one class for each kind of control."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid.choices import PerMassMatrix
from batchpid.computed_torque import advance_with_mass_matrix, check_gain_units, per_inertia
from batchpid.errors import InvalidArgumentError
from sim.engine.building import SceneSpec
from sim.engine.dynamics import scene_dynamics
from sim.engine.pack import Pack
from sim.robot.robot import Robot

Float64 = NDArray[np.float64]

INERTIA_EVERY = 4
"""Sim steps for which a mass matrix is kept within a tick."""


class Control:
    """Base of the controls: the commands of a tick, the PID state, and which joints saturated.

    All arrays are (M, dof). ``reads_qpos_each_step``: whether :meth:`effort` needs qpos at every sim step.
    """

    reads_qpos_each_step = True

    def __init__(self, scene: SceneSpec, params: bp.PIDParams, size: int) -> None:
        self.size, self.dt = size, scene.timestep
        self.saturated: NDArray[np.bool_] = np.zeros((size, len(scene.joints)), bool)
        self.state: Any = None
        self.params = params
        self._scene = scene
        self._setpoint: Float64 = np.zeros((size, len(scene.joints)))
        self._setpoint_rate: Float64 | None = None

    def set_params(self, pack: Pack, params: bp.PIDParams) -> None:
        """Change gains, limits and times; the state is kept."""
        self.params = params

    def reset(self, qpos: Float64, mask: NDArray[np.bool_]) -> None:
        """Start the envs of ``mask`` (M,) anew at ``qpos``."""
        self.saturated[mask] = False
        if self.state is None:
            self.state = bp.init(self.params, qpos)
        else:
            self.state = bp.reset(self.params, self.state, qpos, mask)

    def begin(self, pack: Pack, substeps: int, setpoint: Float64, setpoint_rate: Float64 | None = None) -> None:
        """Take the commands of a tick of so many sim steps."""
        self._substeps, self._setpoint, self._setpoint_rate = substeps, setpoint, setpoint_rate

    def effort(self, pack: Pack, qpos: Float64, feedforward: Float64 | None, step: int, last: bool) -> Float64 | None:
        """Joint efforts of sim step ``step`` of the tick, ``feedforward`` included; None to leave qf alone.

        At the ``last`` one ``saturated`` is brought up to date.
        """
        raise NotImplementedError


class PIDControl(Control):
    """qf = sat(PID(setpoint, qpos) + feedforward)."""

    def set_params(self, pack: Pack, params: bp.PIDParams) -> None:
        """Change gains, limits and times; the state is kept."""
        self.params = params
        self._coefficients = bp.discretise(params, self.dt, self.size)

    def effort(self, pack: Pack, qpos: Float64, feedforward: Float64 | None, step: int, last: bool) -> Float64 | None:
        """Advance the law by one sim step."""
        qvel = pack.read_qvel() if self.params.measurement_rate is not None else None
        inputs = (self._setpoint, qpos, qvel, self._setpoint_rate, feedforward)
        if not last:
            self.state, effort = bp.advance(self._coefficients, self.state, *inputs)
        else:
            self.state, effort, terms = bp.advance(self._coefficients, self.state, *inputs, terms=True)
            self.saturated = terms.saturated
        return effort


class InertiaPIDControl(PIDControl):
    """As :class:`PIDControl`, with gains per unit of inertia; the mass matrix is kept for some sim steps.

    With the whole matrix M the joints' own viscous damping B is made up for as well. The engine takes it
    implicitly, (M + dt B) (v+ - v) = dt (u - B v), so u = (M + dt B) a + B v gives exactly v+ = v + dt a.
    """

    def set_params(self, pack: Pack, params: bp.PIDParams) -> None:
        """Change gains, limits and times; the state is kept."""
        super().set_params(pack, params)
        self._mass_matrix = scene_dynamics(self._scene).mass_matrix
        self._whole = isinstance(params.gain_units, PerMassMatrix)
        damping = np.array([joint.damping for joint in self._scene.joints])
        self._damping = damping if self._whole and damping.any() else None

    def effort(self, pack: Pack, qpos: Float64, feedforward: Float64 | None, step: int, last: bool) -> Float64 | None:
        """Advance the law by one sim step."""
        if step % INERTIA_EVERY == 0:
            # Where the robot will be half-way through these steps, so that the error is zero on average: near upright,
            # axes nearly in line, a jaco2 leaves its path by 18 mrad under matrices that are 0.3 steps ahead.
            kept = min(INERTIA_EVERY, self._substeps - step)
            self._matrix = self._mass_matrix(qpos + 0.5 * (kept - 1) * self.dt * pack.read_qvel())
            if self._damping is not None:
                self._matrix += self.dt * np.diag(self._damping)
        qvel = pack.read_qvel() if self.params.measurement_rate is not None or self._damping is not None else None
        if self._damping is not None and qvel is not None:
            viscous = self._damping * qvel
            feedforward = viscous if feedforward is None else feedforward + viscous
        rates = (qvel if self.params.measurement_rate is not None else None, self._setpoint_rate)
        if self._whole:
            self.state, effort, *terms = advance_with_mass_matrix(
                self._coefficients,
                self.state,
                self._setpoint,
                qpos,
                self._matrix,
                *rates,
                feedforward,
                terms=last,
            )
        else:
            diagonal = np.diagonal(self._matrix, axis1=1, axis2=2)
            coefficients = per_inertia(self._coefficients, diagonal)
            self.state, effort, *terms = bp.advance(
                coefficients, self.state, self._setpoint, qpos, *rates, feedforward, terms=last
            )
        if last:
            self.saturated = terms[0].saturated
        return effort


class DriveControl(Control):
    """PhysX's drive with stiffness kp and damping kd; qf = feedforward.

    With ki the drive's target moves by the integral over kp (:func:`batchpid.drive_target`), so that the drive acts as
    a PID whose P and D the engine integrates implicitly.
    """

    reads_qpos_each_step = False

    def set_params(self, pack: Pack, params: bp.PIDParams) -> None:
        """Change gains, limits and times; the state is kept."""
        self.params = params
        self._integrates = params.ki is not None and bool(np.any(np.asarray(params.ki) > 0))
        self.reads_qpos_each_step = self._integrates
        damping = np.zeros_like(params.kp) if params.kd is None else params.kd
        limit = np.full_like(params.kp, np.inf) if params.effort_max is None else params.effort_max
        pack.write_drive(np.asarray(params.kp), np.asarray(damping), np.asarray(limit))

    def begin(self, pack: Pack, substeps: int, setpoint: Float64, setpoint_rate: Float64 | None = None) -> None:
        """Take a tick's commands, and give them to the drives."""
        super().begin(pack, substeps, setpoint, setpoint_rate)
        pack.write_drive_target(setpoint, np.zeros_like(setpoint) if setpoint_rate is None else setpoint_rate)

    def effort(self, pack: Pack, qpos: Float64, feedforward: Float64 | None, step: int, last: bool) -> Float64 | None:
        """Leave the effort to the drive; its target moves where there is an integral."""
        if self._integrates:
            self.state, target = bp.drive_target(
                self.params,
                self.state,
                self._setpoint,
                qpos,
                self.dt,
                setpoint_rate=self._setpoint_rate,
                feedforward=feedforward,
            )
            pack.write_drive_target(target)
        return feedforward


class EffortControl(Control):
    """qf = sat(the caller's effort + feedforward): the setpoint is the effort."""

    reads_qpos_each_step = False

    def effort(self, pack: Pack, qpos: Float64, feedforward: Float64 | None, step: int, last: bool) -> Float64 | None:
        """Add and saturate."""
        low, high = self.params.effort_min, self.params.effort_max
        total = self._setpoint if feedforward is None else self._setpoint + feedforward
        effort = total if low is None else np.maximum(total, low)
        effort = effort if high is None else np.minimum(effort, high)
        if last:
            self.saturated = effort != total
        return effort


CONTROLS = ("pid", "drive", "effort")


def make_control(name: str, scene: SceneSpec, params: bp.PIDParams, size: int) -> Control:
    """Build the control of that name for ``size`` envs, with ``params`` of one row or ``size``."""
    inertia = params.gain_units is not None
    kinds = {
        "pid": InertiaPIDControl if inertia else PIDControl,
        "drive": DriveControl,
        "effort": EffortControl,
    }
    return kinds[name](scene, params, size)


def default_params(robot: Robot, control: str) -> bp.PIDParams:
    """Return what ``robot`` carries for that control: its drive's gains, its PID's, or just its effort limits."""
    settings = robot.settings
    if control == "effort":
        return robot.params(kp=0.0, ki=0.0, kd=0.0)
    if control == "drive" and settings is not None:
        return robot.params(kp=settings.drive_stiffness, ki=0.0, kd=settings.drive_damping, effort_limit=None)
    return robot.params()


def check_params(params: bp.PIDParams, robot: Robot, num_envs: int, control: str) -> bp.PIDParams:
    """Return ``params`` if they fit the robot, the number of envs and the control.

    Raises
    ------
    InvalidArgumentError
        They do not.
    """
    if not isinstance(params, bp.PIDParams):
        raise InvalidArgumentError(
            "params",
            "must be PIDParams",
            value=params,
            remedy="build them with robot.params() or make_params()",
        )
    if params.gain_units is not None and control != "pid":
        raise InvalidArgumentError(
            "gain_units",
            f"have no meaning under control {control!r}",
            remedy="use control 'pid', or params with gain_units 'effort'",
        )
    check_gain_units(params)
    if params.num_joints != robot.dof:
        raise InvalidArgumentError(
            "params",
            f"hold {params.num_joints} joints, robot {robot.name!r} has {robot.dof}",
            remedy=f"give one gain for each of {', '.join(robot.joint_names)}",
        )
    if params.num_envs not in (1, num_envs):
        raise InvalidArgumentError(
            "params",
            f"hold {params.num_envs} envs, the runner has {num_envs}",
            remedy="give one row, or one row per env",
        )
    return params
