r"""Stability of a robot's sampled PID loop: gains that cannot work at this time step, found before the run diverges.

The effort is held over a step dt, which bounds the gains, unlike in continuous time. With I the inertia that a joint
shows while all others are free, 1 / (M^-1)_jj, and tau the derivative's filter time, a single joint needs::

    ratio = 1/2 (kd dt/I dt/(dt + 2 tau) + 1/2 kp dt^2/I) < 1          (for tau = 0: kd dt/I + kp dt^2/(2 I) < 2)

and the whole robot :func:`batchpid.stability_bound` < 1, which is never below the largest of these: joints with axes
nearly in line turn against each other with less inertia than either has. With params of discretization "implicit"
the ratio, at the gains of the same law at this time step, is below 1 for any gains and time step.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

import batchpid as bp
from batchpid.arrays.array_types import Float64
from batchpid.arrays.choices import PerInertia, PerMassMatrix
from batchpid.checks.warn import warn
from batchpid.errors import InvalidArgumentError
from batchpid.gains.stability import Oscillation, oscillation
from batchpid.law.implicit import as_explicit
from batchpid.sim.robot.description import RobotDescription
from batchpid.sim.robot.dissipation import DISSIPATION


class StabilityReport(NamedTuple):
    """Share of the stability range that the gains use at one pose; arrays are (dof,).

    ``inertia``: I of each joint, with the others free [kg m^2 or kg]; ``kd_dt``: kd dt / I, as the filter passes it;
    ``kp_dt2``: kp dt^2 / I; ``joint_ratio``, ``robot_ratio``: of each joint alone and of the whole robot, 1 is the
    bound; ``participation``: share of each joint in the mode that is the first to become unstable. Followers have the
    figures of their leaders, with which they move.
    """

    inertia: Float64
    kd_dt: Float64
    kp_dt2: Float64
    joint_ratio: Float64
    robot_ratio: float
    participation: Float64
    env: int
    """Env of the params that is the least stable."""


class Gains(NamedTuple):
    """Gains and plant as the law acts on it at one pose: in units of ``matrix`` (n, n), for independent joints (n,).

    kp, ki, kd and the derivative's filter time are (envs, n) or (1, n), of the explicit law; ``damping`` is the viscous
    damping of the joints.
    """

    matrix: Float64
    damping: Float64
    kp: Float64
    ki: Float64
    kd: Float64
    filter_time: Float64


def gains_at(
    robot: RobotDescription, params: bp.PIDParams, qpos: Float64, timestep: float, armature: Float64 | float = 0.0
) -> Gains:
    """Return ``params`` and the robot at ``qpos`` (dof,); ``armature`` (dof,) is inertia of motors [kg m^2 or kg].

    Implicit params become params of the explicit law at ``timestep`` [s].
    """
    params = as_explicit(params, timestep)
    leaves = params.kp, params.ki, params.kd, params.derivative_filter_time
    columns = [np.zeros((1, robot.dof)) if leaf is None else np.asarray(leaf, np.float64) for leaf in leaves]
    coupling, damping = robot.coupling, robot.damping
    columns = [np.broadcast_to(leaf, (len(leaf), robot.dof))[:, coupling.independent] for leaf in columns]
    if isinstance(params.gain_units, PerMassMatrix):
        joints = columns[0].shape[1]
        return Gains(np.eye(joints), np.zeros(joints), *columns)
    matrix = robot.mass_matrix(qpos) + np.diag(np.broadcast_to(armature, robot.dof))
    matrix, damping = coupling.reduced(matrix), coupling.reduced_damping(damping)
    if isinstance(params.gain_units, PerInertia):
        columns[:3] = [leaf * np.diagonal(matrix[0]) for leaf in columns[:3]]
    return Gains(matrix[0], damping, *columns)


def stability_report(
    robot: RobotDescription,
    params: bp.PIDParams,
    qpos: Float64,
    timestep: float,
    armature: Float64 | float = 0.0,
) -> StabilityReport:
    """Return the share of the stability range that ``params`` (their least stable env) use at ``qpos`` (dof,)."""
    gains = gains_at(robot, params, qpos, timestep, armature)
    dt, damping, inverse = (
        timestep,
        gains.damping,
        np.linalg.inv(gains.matrix + 0.5 * timestep * np.diag(gains.damping)),
    )
    rows = max(len(leaf) for leaf in gains[2:])
    kp, _, kd, tau = (np.broadcast_to(leaf, (rows, len(damping))) for leaf in gains[2:])
    matrices = np.broadcast_to(gains.matrix, (rows, *gains.matrix.shape))
    bound = bp.stability_bound(matrices, kp, kd, dt, filter_time=tau, damping=damping)
    worst = int(np.argmax(bound.ratio))
    inertia = 1 / np.diagonal(inverse)
    kp, kd, tau = kp[worst], kd[worst], tau[worst]
    kd_dt, kp_dt2 = kd * dt / inertia * dt / (dt + 2 * tau), kp * dt**2 / inertia
    joint_ratio = 0.5 * (kd_dt + 0.5 * kp_dt2)
    figures = inertia, kd_dt, kp_dt2, joint_ratio, bound.participation[worst]
    inertia, kd_dt, kp_dt2, joint_ratio, participation = map(robot.coupling.of_all, figures)
    return StabilityReport(inertia, kd_dt, kp_dt2, joint_ratio, float(bound.ratio[worst]), participation, worst)


def slow_oscillation(
    robot: RobotDescription, params: bp.PIDParams, qpos: Float64, timestep: float, env: int
) -> Oscillation:
    """Return the least damped oscillation that lasts, of one env's ``params`` at ``qpos`` (dof,)."""
    gains = gains_at(robot, params.for_envs(slice(env, env + 1)), qpos, timestep)
    kp, ki, kd, tau = (leaf[0] for leaf in gains[2:])
    found = oscillation(gains.matrix, kp, ki, kd, timestep, filter_time=tau, damping=gains.damping)
    return found._replace(participation=robot.coupling.of_all(found.participation))


def implicit_remedy(params: bp.PIDParams) -> str:
    """Return the way to act with the gains of ``params`` implicitly, as part of a list of remedies; "" without one."""
    if params.gain_units is None:
        return "control='drive', which integrates these gains implicitly, as MuJoCo does with a servo's kv, "
    return "discretization='implicit', " if isinstance(params.gain_units, PerMassMatrix) else ""


class StabilityWarning(UserWarning):
    """The gains pass the stability bound of the sampled PID loop, see :mod:`batchpid.sim.robot.loop_stability`.

    The bound holds for ideal motors at the start pose, with the armature of actuators. Actuators that delay or limit
    efforts, or measure with errors, have other bounds, and ``dissipation="sapien"`` adds friction that is not in the
    formula: in these cases there is no warning. Under control "drive" in MuJoCo the warning names the first joint that
    sticks, see :mod:`batchpid.sim.robot.drive_chatter`.
    """


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
            env = f", env {report.env}" if params.num_envs > 1 else ""
            warn(
                f"params: the gains are {report.robot_ratio:.3g} times the stability bound of the sampled PID loop, "
                f"mostly of joint {joint!r}{env}, at the start pose with a time step of {self._timestep:g} s: efforts "
                f"alternate from step to step, and the joint chatters or diverges; use at most "
                f"{0.5 / report.robot_ratio:.1g} times these gains, a derivative_filter_time, "
                f"{implicit_remedy(params)}or robot.designed()",
                StabilityWarning,
            )
        self._has_warned = report is not None

    def _beyond(self, params: bp.PIDParams, actuators: bp.Actuators) -> StabilityReport | None:
        """Return the report of params beyond the bound; None for others, and where the bound does not hold."""
        armature = actuators.armature
        if actuators.measures or actuators.delivers or not DISSIPATION[self._robot.dissipation].modelled:
            return None
        if armature is not None and isinstance(params.gain_units, PerMassMatrix):
            return None  # of which the law may not know
        try:
            # The ratio grows with kp and kd, and falls with the filter time: the largest of all envs first.
            largest = (None if leaf is None else leaf.max(0, keepdims=True) for leaf in (params.kp, params.kd))
            tau = params.derivative_filter_time
            worst = dict(zip(("kp", "kd"), largest, strict=True))
            worst["derivative_filter_time"] = None if tau is None else tau.min(0, keepdims=True)
            for each in (params._replace(ki=None, **worst), params):
                least = 0.0 if armature is None else armature.min(0)
                report = stability_report(self._robot, each, self._robot.start, self._timestep, least)
                if report.robot_ratio < 1:
                    return None
        except InvalidArgumentError:  # the robot's mass matrix is not positive definite
            return None
        return report
