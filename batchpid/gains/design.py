r"""Gains from a robot's inertia, without tuning, for any robot.

A joint of inertia I under u = kp (b r - q) + I_term - kd q' has the characteristic polynomial
s^3 + (kd/I) s^2 + (kp/I) s + ki/I. With a bandwidth w, damping ratio zeta and integral time Ti::

    kp = I w^2        kd = 2 zeta w I - c        ki = kp / Ti

where c is the joint's own viscous damping. By default zeta = sqrt(3)/2 and
Ti = 3 sqrt(3) / w: then the three poles coincide at -w / sqrt(3), and a setpoint of small weight b,
which acts through the integral, is reached without overshoot and without a jump of the effort, to 2
% within 13 / w.

Three limits shape the rest. An arm's inertia changes with its pose: I is the largest over the
poses, since a joint lighter than designed for is only damped more. Two light joints nearly in line
move against each other with much less inertia than either: the derivative's filter is as slow as
the stability bound over all poses requires (:mod:`batchpid.gains.stability`). Where a filter that
slow would reduce the damping, the bandwidth is reduced.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from batchpid.arrays.array_types import CHOICES, Float64
from batchpid.checks import at_least, broadcast, choice, number, positive, time_step
from batchpid.errors import InvalidArgumentError
from batchpid.gains.stability import stability_bound
from batchpid.law.params import PIDParams
from batchpid.motors.coupling import Coupling

FILTER_STEPS = 4.0
"""Least filter time of the derivative, in sampling steps: against quantisation noise."""
FILTER_SHARE = 0.3
"""Largest filter time, as a share of 1 / w: it costs at most this many radians of phase at w."""
DAMPING_RATIO, INTEGRAL_TIME = math.sqrt(3) / 2, 3 * math.sqrt(3)
"""zeta, and Ti in units of 1 / w, of three equal poles."""
OWN_SHARE = 0.2
"""Least share of kd that remains after the joint's damping ``load`` is subtracted from it: in poses
with a larger inertia, that damping does less.
"""
BACK_OFF = 0.8
"""Factor by which the bandwidth is reduced, until the filter is fast enough."""


def pid_from_inertia(
    inertia: ArrayLike,
    bandwidth_hz: ArrayLike,
    damping_ratio: float = DAMPING_RATIO,
    *,
    integral_time: float | None = None,
    damping: ArrayLike = 0.0,
) -> dict[str, Float64]:
    """Return kp, ki and kd for joints of known inertia, as options of :func:`batchpid.make_params`.

    Parameters
    ----------
    inertia
        (joints,) [kg m^2 or kg].
    bandwidth_hz
        w / (2 pi), a number or (joints,) [Hz].
    damping_ratio
        zeta.
    integral_time
        Ti [s]; default 3 sqrt(3) / w, inf for no integral.
    damping
        Viscous damping of the joints (joints,) [N m s/rad or N s/m].
    """
    # Gains of three equal poles, with the joint's own damping as a part of kd.
    w = 2 * np.pi * np.asarray(bandwidth_hz, np.float64)
    load = np.asarray(damping, np.float64)
    # A joint whose own damping exceeds zeta needs the stiffness of a heavier one to be as fast.
    effective = np.maximum(inertia, load / (2 * damping_ratio * w))
    kp = effective * w**2
    full = 2 * damping_ratio * w * effective
    return {
        "kp": kp,
        "ki": kp / (INTEGRAL_TIME / w if integral_time is None else integral_time),
        "kd": np.maximum(full - load, OWN_SHARE * full),
    }


def design_gains(
    robot: Any,
    bandwidth_hz: float = 3.0,
    damping_ratio: float = DAMPING_RATIO,
    *,
    integral_time: float | None = None,
    setpoint_weight: float = 0.1,
    dt: float = 1 / 2000,
    poses: ArrayLike | None = None,
    gain_units: str = "effort",
    discretization: str = "explicit",
    margin: float = 0.5,
    load: ArrayLike = 0.0,
    **options: Any,
) -> PIDParams:
    """Return params for ``robot`` from its inertia alone.

    Parameters
    ----------
    robot
        A :class:`batchpid.sim.Robot`, or another object with its ``mass_matrix(poses)``,
        ``sample(count, seed=)``, ``params(**options)`` and ``damping``. If it has a ``coupling``
        (:mod:`batchpid.motors.coupling`), the gains are for the inertia that moves with each
        leader. Followers get the same, which have no effect.
    bandwidth_hz, damping_ratio
        Of the closed loop, at the largest inertia. A step settles to 2 % in about 2 / bandwidth_hz
        seconds.
    integral_time
        Ti [s]; default 3 sqrt(3) / w, inf for no integral.
    setpoint_weight
        b; without an integral it is 1.
    dt
        Control and simulation step [s].
    poses
        (n, dof) over which the largest inertia is taken and stability is kept; default 200 seeded
        ones within the limits.
    gain_units
        Unit of the gains: "effort", or per "mass_matrix" (:mod:`batchpid.law.computed_torque`).
    discretization
        "explicit", or "implicit" for gains per "mass_matrix" (:mod:`batchpid.law.coefficients`): stable
        at any ``dt``, so that the bandwidth is kept and the derivative is not filtered.
    margin
        Share of the stability range that may be used, in [0.001, 0.999].
    load
        Least inertia that the joints are designed for, with gain_units "effort" (dof,) [kg m^2 or
        kg], such as that of a base that legs carry.
    options
        Options of ``robot.params``; they replace the designed ones.

    Raises
    ------
    InvalidArgumentError
        A number out of range, an unknown unit, a load for gains not as "effort", an implicit law
        with gains not per "mass_matrix", or a robot whose mass matrix is not positive definite.
    """
    bandwidth = positive("bandwidth_hz", bandwidth_hz, "Hz")
    positive("damping_ratio", damping_ratio, "zeta")
    time_step("dt", dt)
    number("margin", margin, 1e-3, 1 - 1e-3, "share of the stability range")
    # Without an integral a setpoint weight would leave an error.
    integrates = integral_time is None or integral_time != math.inf
    if integral_time is not None and integrates:
        positive("integral_time", integral_time, "s")
    choice("gain_units", gain_units, CHOICES["gain_units"])
    is_explicit = choice("discretization", discretization, CHOICES["discretization"]) == "explicit"
    least = at_least("load", broadcast("load", load, robot.damping.shape), 0.0)
    if gain_units != "effort" and least.any():
        remedy = "leave it out: these gains are per mass matrix"
        raise InvalidArgumentError(
            "load", f"has no effect with gain_units {gain_units!r}", remedy=remedy
        )
    # A leader carries its followers, so gains are designed for the reduced inertias.
    mass = robot.mass_matrix(robot.sample(200, seed=0) if poses is None else np.atleast_2d(poses))
    coupling = getattr(robot, "coupling", Coupling.of(mass.shape[-1]))
    mass = coupling.reduced(mass)
    viscous = coupling.reduced_damping(robot.damping)
    diagonal = np.diagonal(mass, axis1=1, axis2=2)
    carried = np.maximum(diagonal.max(0), coupling.reduced_damping(least))
    # The loop with the mass matrix has unit inertias, and compensates the joints' damping.
    if gain_units == "effort":
        inertia, damping = (carried, viscous)
    else:
        inertia, damping = (np.ones_like(carried), 0.0)
    while True:
        gains = pid_from_inertia(
            inertia, bandwidth, damping_ratio, integral_time=integral_time, damping=damping
        )
        if is_explicit:
            filter_time = _filter_time(
                mass,
                gains,
                dt,
                viscous,
                gain_units,
                margin,
            )
        else:
            filter_time = 0.0
        if (
            filter_time <= max(FILTER_SHARE / (2 * np.pi * bandwidth), FILTER_STEPS * dt)
            or bandwidth < 1e-3
        ):
            break
        bandwidth *= BACK_OFF
    designed = {
        **{name: coupling.of_all(gain) for name, gain in gains.items()},
        "setpoint_weight": setpoint_weight if integrates else 1.0,
        "derivative_filter_time": filter_time,
        "gain_units": gain_units,
        "discretization": discretization,
    }
    # A limit that the caller names replaces the robot's.
    limit = getattr(robot, "design_effort_limit", None)
    if limit is not None and not {"effort_limit", "effort_min", "effort_max"} & set(options):
        designed["effort_limit"] = limit
    params: PIDParams = robot.params(**(designed | options))
    return params


def _filter_time(
    mass: Float64,
    gains: dict[str, Float64],
    dt: float,
    damping: Float64,
    gain_units: str,
    margin: float,
) -> float:
    """Return the shortest filter time from FILTER_STEPS on that keeps the ratio below ``margin`` at
    every pose.
    """
    joints = mass.shape[1]
    if gain_units == "mass_matrix":  # u = M a: every joint is a unit inertia, coupled to no other
        mass = np.eye(joints)[None]
        damping = np.zeros(joints)

    def ratios(filter_time: float) -> Float64:
        return stability_bound(
            mass,
            gains["kp"],
            gains["kd"],
            dt,
            filter_time=filter_time,
            damping=damping,
        ).ratio

    low = FILTER_STEPS * dt
    at_low = ratios(low)
    if at_low.max() <= margin:
        return low
    worst = np.argsort(at_low)[-10:]  # the critical pose is among these
    mass = mass[worst]

    # The filter passes dt / (dt + 2 tau), so the ratio falls about as 1 / tau down to kp's own
    # share of it.
    high = low
    while ratios(high).max() > margin:
        high *= 2
        if high > 1e3:
            return math.inf
    # Bisection in the logarithm: 40 halvings exceed the precision of a float.
    for _ in range(40):
        middle = math.sqrt(low * high)
        if ratios(middle).max() > margin:
            low, high = (middle, high)
        else:
            low, high = (low, middle)
    return high
