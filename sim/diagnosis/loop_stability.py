r"""Stability of a robot's sampled PID loop: gains that cannot work at this time step, found before
the run diverges.

The effort is held over a step dt, which bounds the gains, unlike in continuous time: the ratio of
:func:`batchpid.stability_bound` has to be below 1. With params of discretization "implicit" the
ratio, at the gains of the same law at this time step, is below 1 for any gains and time step.

Motors that are late lower the bound. Their delay and lag, the sensors' delay, and strength,
armature and viscous friction of the motors are counted, each where it is known.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

import batchpid as bp
from batchpid.arrays.array_types import Array, Document, Float64
from batchpid.errors import InvalidArgumentError, warn
from batchpid.law.coefficients import as_explicit

if TYPE_CHECKING:
    from batchpid.sim.robot.robot import Robot

NEAR_BOUND = 0.5
"""Share of the stability range from which gains are reported: other poses may have less inertia."""


def _loop(
    robot: Robot,
    params: bp.PIDParams,
    qpos: Float64,
    timestep: float,
    actuators: bp.Actuators | None,
) -> Document:
    """Return plant and gains at ``qpos`` (dof,), by the names of :func:`batchpid.stability_bound`.

    Arrays are (1 or envs, n, ...) of the independent joints. Strength of the motors is part of the
    gains, or of the model.
    """
    params = as_explicit(params, timestep)
    motors = actuators or bp.Actuators()
    coupling = robot.coupling

    def table(leaf: Array, neutral: float = 0.0) -> Float64:
        if leaf is None:
            return np.full((1, robot.dof), neutral)
        rows = np.atleast_2d(np.asarray(leaf, np.float64))
        return np.broadcast_to(rows, (len(rows), robot.dof))

    def column(leaf: Array, neutral: float = 0.0) -> Float64:
        return table(leaf, neutral)[:, coupling.independent]

    def matrix(armature: Array) -> Float64:
        added = table(armature)[:, None] * np.eye(robot.dof)
        inertia: Float64 = coupling.reduced(robot.mass_matrix(qpos) + added)
        return inertia

    loop: Document = {name: column(getattr(params, name)) for name in ("kp", "kd")}
    eye = np.eye(loop["kp"].shape[1])
    strength = column(motors.strength, 1.0)
    viscous = robot.damping + table(motors.viscous)
    damping = np.stack([coupling.reduced_damping(row) for row in viscous])
    if params.gain_units is None:
        loop = {name: strength * gain for name, gain in loop.items()}
        loop |= {"mass_matrix": matrix(motors.armature), "damping": damping}
    elif actuators is None:  # the law knows the plant
        loop["mass_matrix"] = eye[None]
    else:
        # The law knows the damping, too, as part of its matrix.
        described = robot.actuators or bp.Actuators()
        implicit = coupling.reduced_damping(robot.damping + table(described.viscous)[0])
        model = matrix(described.armature)[:1] + timestep * eye * implicit
        plant = matrix(motors.armature) + timestep * eye * damping[:, None]
        loop |= {"mass_matrix": plant, "model": strength[..., None] * model}
    loop["filter_time"] = column(params.derivative_filter_time)
    loop["delay"] = column(motors.command_delay) + column(motors.sensor_delay)
    loop["lag"] = column(motors.lag)
    return loop


def stability_report(
    robot: Robot,
    params: bp.PIDParams,
    qpos: Float64,
    timestep: float,
    actuators: bp.Actuators | None = None,
) -> tuple[float, Float64, int, str, str]:
    """Return the share of the stability range that ``params`` (their least stable env) use at
    ``qpos`` (dof,), of which 1 is the bound.

    Further results are the share of each joint (dof,) in the mode that is the first to become
    unstable, where a follower has its leader's; the least stable env of the params and actuators;
    the motion of a robot beyond the bound; and the remedy: gains that would be stable, and other
    ways to make the loop stable.

    ``actuators`` are motors and sensors, of which delay, lag, strength, armature and viscous
    friction count; rows are envs, as of the params.
    """
    loop = _loop(robot, params, qpos, timestep, actuators)
    rows = max(len(leaf) for leaf in loop.values())
    mass_matrix = np.broadcast_to(loop.pop("mass_matrix"), (rows, *loop["kp"].shape[1:] * 2))
    bound = bp.stability_bound(mass_matrix, dt=timestep, **loop)
    worst = int(np.argmax(bound.ratio))
    ratio = float(bound.ratio[worst])
    effect = "efforts alternate from step to step, and the joint chatters or diverges"
    remedy = f"use at most {0.5 / max(ratio, 1e-9):.1g} times these gains"
    if np.isinf(ratio):
        remedy = "use a kd that is larger than kp times the delay and lag"
    if loop["delay"].any() or loop["lag"].any():
        effect = "with these delays and lags the joint oscillates or diverges"
    elif params.gain_units is None:
        # A drive integrates these gains implicitly, as MuJoCo does with a servo's kv.
        remedy += ", control='drive'"
    else:
        remedy += ", discretization='implicit'"
    shares = robot.coupling.of_all(bound.participation[worst])
    return ratio, shares, worst, effect, f"{remedy}, or robot.designed()"


class StabilityWarning(UserWarning):
    """The gains pass the stability bound of the sampled PID loop, see
    :mod:`batchpid.sim.diagnosis.loop_stability`.

    The bound holds at the start pose, and counts delays, lag, strength, armature and viscous
    friction of the actuators. It does not count noise, gravity that is compensated late, and
    limits: beyond the bound, a joint with an effort limit oscillates instead of diverging, and one
    that leans on its position limit is held there. There is no warning with
    ``dissipation="sapien"``, which adds friction that the formula lacks.
    """


MOST = 64
"""Largest number of envs that are checked: a draw of that many motors shows the range of all."""


class StabilityCheck:
    """Check of gains against the stability bound. It warns when they pass it, and again only after
    a return within it.

    Parameters
    ----------
    robot, timestep
        The bound is taken at the robot's start pose with this time step [s].
    """

    def __init__(self, robot: Robot, timestep: float) -> None:
        self._robot = robot
        self._timestep = timestep
        self._has_warned = False

    def check(self, params: bp.PIDParams, actuators: bp.Actuators | None) -> None:
        """Warn if ``params`` pass the bound."""
        # SAPIEN's own friction is not in the formula.
        if self._robot.source.dissipation == "sapien":
            return
        motors = None
        if actuators is not None and not actuators.is_ideal:
            motors = actuators.for_envs(slice(0, MOST))
        if params.num_envs > 1 and motors is not None:
            params = params.for_envs(slice(0, MOST))
        start = self._robot.start
        try:
            report = stability_report(self._robot, params, start, self._timestep, motors)
            ratio, participation, worst, effect, remedy = report
        except InvalidArgumentError:  # the robot's mass matrix is not positive definite
            return
        # A caller who changes gains in a loop gets one warning.
        is_beyond = ratio >= 1
        if is_beyond and not self._has_warned:
            joint = self._robot.joint_names[int(np.argmax(participation))]
            env = ""
            if params.num_envs > 1 or (motors is not None and motors.num_envs > 1):
                env = f", env {worst}"
            warn(
                f"params: the gains are {ratio:.3g} times the stability bound of the"
                f" sampled PID loop, mostly of joint {joint!r}{env}, at the start pose with a time"
                f" step of {self._timestep:g} s: {effect}; {remedy}",
                StabilityWarning,
            )
        self._has_warned = is_beyond
