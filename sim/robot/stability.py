r"""The stability advisor: which gains cannot work at this time step, before a run goes to NaN.

The effort is held over a step dt, so gains have a bound that continuous time does not know. With I the inertia that a
joint shows with all others free, 1 / (M^-1)_jj, and tau the derivative's filter time, a joint alone needs::

    ratio = 1/2 (kd dt/I dt/(dt + 2 tau) + 1/2 kp dt^2/I) < 1          (for tau = 0: kd dt/I + kp dt^2/(2 I) < 2)

and the robot as a whole :func:`batchpid.stability_bound` < 1, which is never below the largest of these: joints with
axes nearly in line turn against each other with less inertia than either has.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid.choices import PerInertia, PerMassMatrix
from sim.robot.description import RobotDescription

Float64 = NDArray[np.float64]


class Stability(NamedTuple):
    """How much of the stability range the gains use at one pose; arrays are (dof,)."""

    inertia: Float64
    """I, of each joint with the others free [kg m^2 or kg]."""
    kd_dt: Float64
    """kd dt / I, as the filter passes it."""
    kp_dt2: Float64
    """kp dt^2 / I."""
    ratio: Float64
    """Of each joint alone: 1 is the bound."""
    robot: float
    """Of the robot as a whole: 1 is the boundary."""
    participation: Float64
    """The share of each joint in the mode that goes first."""


def stability(robot: RobotDescription, params: bp.PIDParams, qpos: Float64, timestep: float) -> Stability:
    """How much of the stability range ``params`` (their least stable env) use at ``qpos`` (dof,)."""
    matrix = robot.mass_matrix(qpos)
    dt, damping = timestep, np.array([joint.damping for joint in robot.joints])
    kp, kd, tau = (
        np.zeros((1, robot.dof)) if leaf is None else np.asarray(leaf, np.float64)
        for leaf in (params.kp, params.kd, params.derivative_filter_time)
    )
    if isinstance(params.gain_units, PerInertia):
        diagonal = np.diagonal(matrix, axis1=1, axis2=2)
        kp, kd = kp * diagonal, kd * diagonal
    if isinstance(params.gain_units, PerMassMatrix):
        matrix, damping = np.eye(robot.dof)[None], np.zeros(robot.dof)
    bound = bp.stability_bound(
        np.broadcast_to(matrix, (params.num_envs, *matrix.shape[1:])),
        kp,
        kd,
        dt,
        filter_time=tau,
        damping=damping,
    )
    worst = int(np.argmax(bound.ratio))
    inertia = 1 / np.diagonal(np.linalg.inv(matrix[0] + 0.5 * dt * np.diag(damping)))
    kp, kd, tau = (np.broadcast_to(leaf, (params.num_envs, robot.dof))[worst] for leaf in (kp, kd, tau))
    kd_dt, kp_dt2 = kd * dt / inertia * dt / (dt + 2 * tau), kp * dt**2 / inertia
    return Stability(
        inertia=inertia,
        kd_dt=kd_dt,
        kp_dt2=kp_dt2,
        ratio=0.5 * (kd_dt + 0.5 * kp_dt2),
        robot=float(bound.ratio[worst]),
        participation=bound.participation[worst],
    )
