r"""Stability of a robot's sampled PID loop: gains that cannot work at this time step, found before the run diverges.

The effort is held over a step dt, which bounds the gains, unlike in continuous time. With I the inertia that a joint
shows while all others are free, 1 / (M^-1)_jj, and tau the derivative's filter time, a single joint needs::

    ratio = 1/2 (kd dt/I dt/(dt + 2 tau) + 1/2 kp dt^2/I) < 1          (for tau = 0: kd dt/I + kp dt^2/(2 I) < 2)

and the whole robot :func:`batchpid.stability_bound` < 1, which is never below the largest of these: joints with axes
nearly in line turn against each other with less inertia than either has.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid.choices import PerInertia, PerMassMatrix
from sim.robot.description import RobotDescription

Float64 = NDArray[np.float64]


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


def stability_report(robot: RobotDescription, params: bp.PIDParams, qpos: Float64, timestep: float) -> StabilityReport:
    """Return the share of the stability range that ``params`` (their least stable env) use at ``qpos`` (dof,)."""
    matrix = robot.mass_matrix(qpos)
    dt, damping, coupling = timestep, robot.damping, robot.coupling
    kp, kd, tau = (
        np.zeros((1, robot.dof)) if leaf is None else np.asarray(leaf, np.float64)
        for leaf in (params.kp, params.kd, params.derivative_filter_time)
    )
    if coupling is not None:
        matrix, damping = coupling.reduced(matrix), coupling.reduced_damping(damping)
        kp, kd, tau = (np.broadcast_to(leaf, (len(leaf), robot.dof))[:, coupling.independent] for leaf in (kp, kd, tau))
    joints = matrix.shape[1]
    if isinstance(params.gain_units, PerInertia):
        diagonal = np.diagonal(matrix, axis1=1, axis2=2)
        kp, kd = kp * diagonal, kd * diagonal
    if isinstance(params.gain_units, PerMassMatrix):
        matrix, damping = np.eye(joints)[None], np.zeros(joints)
    matrices = np.broadcast_to(matrix, (params.num_envs, *matrix.shape[1:]))
    bound = bp.stability_bound(matrices, kp, kd, dt, filter_time=tau, damping=damping)
    worst = int(np.argmax(bound.ratio))
    inertia = 1 / np.diagonal(np.linalg.inv(matrix[0] + 0.5 * dt * np.diag(damping)))
    kp, kd, tau = (np.broadcast_to(leaf, (params.num_envs, joints))[worst] for leaf in (kp, kd, tau))
    kd_dt, kp_dt2 = kd * dt / inertia * dt / (dt + 2 * tau), kp * dt**2 / inertia
    joint_ratio = 0.5 * (kd_dt + 0.5 * kp_dt2)
    figures = [inertia, kd_dt, kp_dt2, joint_ratio, bound.participation[worst]]
    if coupling is not None:
        figures = [coupling.of_all(figure) for figure in figures]
    inertia, kd_dt, kp_dt2, joint_ratio, participation = figures
    return StabilityReport(inertia, kd_dt, kp_dt2, joint_ratio, float(bound.ratio[worst]), participation)
