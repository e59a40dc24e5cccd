r"""Stability of a robot's sampled PID loop: gains that cannot work at this time step, found before the run diverges.

The effort is held over a step dt, which bounds the gains, unlike in continuous time. With I the inertia that a joint
shows while all others are free, 1 / (M^-1)_jj, and tau the derivative's filter time, a single joint needs::

    ratio = 1/2 (kd dt/I dt/(dt + 2 tau) + 1/2 kp dt^2/I) < 1          (for tau = 0: kd dt/I + kp dt^2/(2 I) < 2)

and the whole robot :func:`batchpid.stability_bound` < 1, which is never below the largest of these: joints with axes
nearly in line turn against each other with less inertia than either has. With params of discretization "implicit"
the ratio, at the gains of the same law at this time step, is below 1 for any gains and time step.

Motors that are late lower the bound. Their delay and lag, the sensors' delay, and strength, armature and viscous
friction of the motors are counted, each where it is known.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

import batchpid as bp
from batchpid.arrays.array_types import Array, Document, Float64
from batchpid.arrays.choices import PerMassMatrix
from batchpid.checks.warn import warn
from batchpid.errors import InvalidArgumentError
from batchpid.gains.stability import Oscillation, oscillation
from batchpid.law.implicit import as_explicit
from batchpid.sim.robot.actuator_checks import known_joints
from batchpid.sim.robot.description import RobotDescription
from batchpid.sim.robot.parts import DISSIPATION


class StabilityReport(NamedTuple):
    """Share of the stability range that the gains use at one pose; arrays are (dof,).

    ``joint_ratio``, ``robot_ratio``: of each joint alone and of the whole robot, 1 is the bound; ``participation``:
    share of each joint in the mode that is the first to become unstable. Followers have the figures of their leaders,
    with which they move.
    """

    joint_ratio: Float64
    robot_ratio: float
    participation: Float64
    env: int
    """Env of the params and actuators that is the least stable."""
    late: bool
    """True if efforts or measurements are late."""

    @property
    def effect(self) -> str:
        """Motion of a robot beyond the bound."""
        if self.late:
            return "with motors as late as these the joint oscillates or diverges"
        return "efforts alternate from step to step, and the joint chatters or diverges"

    @property
    def remedy(self) -> str:
        """Gains that would be stable."""
        if np.isinf(self.robot_ratio):
            return "use a kd that is larger than kp times the delay and lag"
        return f"use at most {0.5 / self.robot_ratio:.1g} times these gains"


class Gains(NamedTuple):
    """Gains and plant as the law acts on it at one pose: in units of ``matrix``, for independent joints (n,).

    ``matrix``, ``model`` and ``damping`` are (1 or rows, n, n) and (1 or rows, n); kp, ki, kd, the derivative's filter
    time, ``delay`` and ``lag`` are (1 or rows, n), of the explicit law, rows being those of the params or of the
    actuators. ``model`` (1 or rows, n, n) multiplies the law's output; None: it is an effort. The motors' strength is
    part of the gains, or of the model.
    """

    matrix: Float64
    damping: Float64
    kp: Float64
    ki: Float64
    kd: Float64
    filter_time: Float64
    delay: Float64
    lag: Float64
    model: Float64 | None


def gains_at(
    robot: RobotDescription,
    params: bp.PIDParams,
    qpos: Float64,
    timestep: float,
    actuators: bp.Actuators | None = None,
) -> Gains:
    """Return ``params`` and the robot at ``qpos`` (dof,), with ``actuators`` as motors.

    Implicit params become params of the explicit law at ``timestep`` [s].
    """
    params, motors, independent = as_explicit(params, timestep), actuators or bp.Actuators(), robot.coupling.independent

    def column(leaf: Array, neutral: float = 0.0) -> Float64:
        rows = np.full((1, robot.dof), neutral) if leaf is None else np.asarray(leaf, np.float64)
        return np.broadcast_to(rows, (len(rows), robot.dof))

    kp, ki, kd, tau = (
        column(leaf)[:, independent] for leaf in (params.kp, params.ki, params.kd, params.derivative_filter_time)
    )
    delay = column(motors.command_delay) + column(motors.sensor_delay)
    late, lag = delay[:, independent], column(motors.lag)[:, independent]
    strength = column(motors.strength, 1.0)[:, independent]
    of_mass, joints = isinstance(params.gain_units, PerMassMatrix), late.shape[1]
    if of_mass and actuators is None:  # the law knows the plant
        return Gains(np.eye(joints)[None], np.zeros((1, joints)), kp, ki, kd, tau, late, lag, None)
    matrix, damping = _matrix(robot, qpos, column(motors.armature)), robot.damping + column(motors.viscous)
    damping = np.stack([robot.coupling.reduced_damping(row) for row in damping])
    if not of_mass:
        return Gains(matrix, damping, strength * kp, strength * ki, strength * kd, tau, late, lag, None)
    # The law knows the damping, too, as part of its matrix.
    known, eye = known_joints(robot), np.eye(joints)
    model = _matrix(robot, qpos, known.armature[None])
    model = model + timestep * eye * robot.coupling.reduced_damping(robot.damping + known.viscous)
    matrix = matrix + timestep * eye * damping[:, None, :]
    return Gains(matrix, np.zeros_like(damping), kp, ki, kd, tau, late, lag, strength[..., None] * model)


def _matrix(robot: RobotDescription, qpos: Float64, armature: Float64) -> Float64:
    """Return the mass matrices (rows, n, n) of independent joints with ``armature`` (rows, dof)."""
    return robot.coupling.reduced(robot.mass_matrix(qpos) + armature[:, None, :] * np.eye(robot.dof))


def stability_report(
    robot: RobotDescription,
    params: bp.PIDParams,
    qpos: Float64,
    timestep: float,
    actuators: bp.Actuators | None = None,
) -> StabilityReport:
    """Return the share of the stability range that ``params`` (their least stable env) use at ``qpos`` (dof,).

    ``actuators`` are motors and sensors, of which delay, lag, strength, armature and viscous friction count; rows are
    envs, as of the params.
    """
    gains, dt = gains_at(robot, params, qpos, timestep, actuators), timestep
    rows = max(len(leaf) for leaf in gains if leaf is not None)
    matrices, damping, kp, _, kd, tau, delay, lag = (
        np.broadcast_to(leaf, (rows, *leaf.shape[1:])) for leaf in gains[:8]
    )
    late = {"filter_time": tau, "damping": damping, "delay": delay, "lag": lag}
    bound = bp.stability_bound(matrices, kp, kd, dt, model=gains.model, **late)
    worst = int(np.argmax(bound.ratio))
    inertia = 1 / np.diagonal(np.linalg.inv(matrices[worst] + 0.5 * dt * np.diag(damping[worst])))
    kp, kd, tau = kp[worst], kd[worst], tau[worst]
    if gains.model is not None:
        unit = np.diagonal(gains.model[min(worst, len(gains.model) - 1)])
        kp, kd = unit * kp, unit * kd
    alone = {"filter_time": tau, "delay": delay[worst], "lag": lag[worst]}  # the inertia includes the damping
    columns = {name: leaf[:, None] for name, leaf in alone.items()}
    joint_ratio = bp.stability_bound(inertia[:, None, None], kp[:, None], kd[:, None], dt, **columns).ratio
    joint_ratio, participation = map(robot.coupling.of_all, (joint_ratio, bound.participation[worst]))
    ratio, is_late = float(bound.ratio[worst]), bool(delay.any() or lag.any())
    return StabilityReport(joint_ratio, ratio, participation, worst, is_late)


def slow_oscillation(
    robot: RobotDescription, params: bp.PIDParams, qpos: Float64, timestep: float, env: int
) -> Oscillation:
    """Return the least damped oscillation that lasts, of one env's ``params`` at ``qpos`` (dof,)."""
    gains = gains_at(robot, params.for_envs(slice(env, env + 1)), qpos, timestep)
    matrix, damping, kp, ki, kd, tau = (leaf[0] for leaf in gains[:6])
    found = oscillation(matrix, kp, ki, kd, timestep, filter_time=tau, damping=damping)
    return found._replace(participation=robot.coupling.of_all(found.participation))


def implicit_remedy(params: bp.PIDParams) -> str:
    """Return the way to act with the gains of ``params`` implicitly, as part of a list of remedies; "" without one."""
    if params.gain_units is None:
        return "control='drive', which integrates these gains implicitly, as MuJoCo does with a servo's kv, "
    return "discretization='implicit', " if isinstance(params.gain_units, PerMassMatrix) else ""


class StabilityWarning(UserWarning):
    """The gains pass the stability bound of the sampled PID loop, see :mod:`batchpid.sim.robot.loop_stability`.

    The bound holds at the start pose, and counts delays, lag, strength, armature and viscous friction of the actuators.
    Noise and limits of efforts are not in it: beyond it, a joint with limits oscillates instead of diverging. With
    ``dissipation="sapien"``, which adds friction that is not in the formula, there is no warning.
    """


MOST = 64
"""Envs with late motors that are checked one by one, once the extreme of all of them is beyond the bound."""
_LEAST_STABLE_GAINS = {"kp": np.max, "kd": np.max, "derivative_filter_time": np.min}
_LATEST = {name: np.max for name in ("command_delay", "sensor_delay", "lag", "strength")} | {
    name: np.min for name in ("armature", "viscous")
}
"""Ends of the ranges at which a loop is the least stable."""


class StabilityCheck:
    """Check of gains against the stability bound. It warns when they pass it, and again only after a return within it.

    Parameters
    ----------
    robot, timestep
        The bound is taken at the robot's start pose with this time step [s].
    """

    def __init__(self, robot: RobotDescription, timestep: float) -> None:
        self._robot, self._timestep = robot, timestep
        self._has_warned = False

    def check(self, params: bp.PIDParams, actuators: bp.Actuators | None) -> None:
        """Warn if ``params`` pass the bound."""
        report = self._beyond(params, bp.Actuators() if actuators is None else actuators)
        if report is not None and not self._has_warned:
            joint = self._robot.joint_names[int(np.argmax(report.participation))]
            rows = max(params.num_envs, 1 if actuators is None else actuators.num_envs)
            env = f", env {report.env}" if rows > 1 else ""
            warn(
                f"params: the gains are {report.robot_ratio:.3g} times the stability bound of the sampled PID loop, "
                f"mostly of joint {joint!r}{env}, at the start pose with a time step of {self._timestep:g} s: "
                f"{report.effect}; {report.remedy}, a derivative_filter_time, "
                f"{'' if report.late else implicit_remedy(params)}or robot.designed()",
                StabilityWarning,
            )
        self._has_warned = report is not None

    def _beyond(self, params: bp.PIDParams, actuators: bp.Actuators) -> StabilityReport | None:
        """Return the report of params beyond the bound; None for others, and where the bound does not hold."""
        if not DISSIPATION[self._robot.dissipation].modelled:
            return None
        motors = None if actuators.is_ideal else actuators
        envs = np.arange(max(params.num_envs, actuators.num_envs))
        try:
            report = self._report(
                _extreme(params, _LEAST_STABLE_GAINS), None if motors is None else _extreme(motors, _LATEST)
            )
            if report.robot_ratio < 1 or len(envs) == 1:
                return report if report.robot_ratio >= 1 else None
            if motors is not None and len(envs) > MOST:
                envs = envs[np.argsort(_urgency(params, motors), kind="stable")[-MOST:]]
            report = self._report(params.for_envs(envs), None if motors is None else motors.for_envs(envs))
        except InvalidArgumentError:  # the robot's mass matrix is not positive definite
            return None
        return report._replace(env=int(envs[report.env])) if report.robot_ratio >= 1 else None

    def _report(self, params: bp.PIDParams, actuators: bp.Actuators | None) -> StabilityReport:
        return stability_report(self._robot, params, self._robot.start, self._timestep, actuators=actuators)


def _extreme(record: Any, ends: Document) -> Any:
    """Return params or actuators of one env with the end of the range of all envs that is the least stable."""
    leaves = {name: getattr(record, name) for name in ends}
    found = {name: ends[name](leaf, 0, keepdims=True) for name, leaf in leaves.items() if leaf is not None}
    return record.for_envs(slice(0, 1))._replace(**found)


def _urgency(params: bp.PIDParams, motors: bp.Actuators) -> Float64:
    """Return a figure (envs,) that grows with gains and delays over their means; the largest are checked."""
    late = (motors.command_delay, motors.sensor_delay, motors.strength)
    found = np.zeros((max(params.num_envs, motors.num_envs), 1))
    for leaf in (params.kp, params.kd, *late):
        if leaf is not None:
            found = found + np.asarray(leaf, np.float64) / (np.mean(leaf, 0) + 1e-300)
    urgency: Float64 = found.max(1)
    return urgency
