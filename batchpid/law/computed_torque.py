r"""Gains per unit of inertia: the law's output is an acceleration, and the robot's mass matrix M(q)
makes it an effort.

With kp = w^2 and kd = 2 zeta w, all joints of all robots respond in the same way, in every pose,
and do not disturb each other: u = M(q) a + passive force, computed-torque control (M. W. Spong, S.
Hutchinson and M. Vidyasagar, Robot Modeling and Control, 2nd ed., section 9.3).

Where limits apply, clipping each joint of u alone would change the direction of the acceleration
and couple the joints again. So a is scaled as a whole::

    u = s M a + passive,   s = the largest in [0, 1] with all of u within its limits

which keeps its direction (P. J. Campo and M. Morari, "Robust control of processes subject to
saturation nonlinearities", Computers and Chemical Engineering 14, 1990). From rest the robot stays
on the straight line to its setpoint, however tight the limits. A joint whose passive force alone
exceeds its limit is clipped, and left out of s. While s < 1, conditional integration does not
integrate further into the direction of a.

A limit of the effort's rate holds each joint back by itself. Where it does, conditional integration
does not integrate further into the direction of u - effort.

A setpoint's acceleration r'' is added to the law's: u = M (a + r'') + passive force.

The time step limits the gains per mass matrix, unless the law is implicit
(:mod:`batchpid.law.coefficients`).
"""

from __future__ import annotations

from batchpid.arrays.array_types import Array, ArrayModule, Conditional, PerMassMatrix
from batchpid.arrays.elementwise import clip, in_dtype_of, matrix_vector, namespace, row_minimum
from batchpid.errors import InvalidArgumentError
from batchpid.law.coefficients import Coefficients
from batchpid.law.params import PIDParams
from batchpid.law.pid import advance
from batchpid.law.state import PIDState, Terms


def advance_with_mass_matrix(
    k: Coefficients,
    state: PIDState,
    setpoint: Array,
    measurement: Array,
    mass_matrix: Array,
    measurement_rate: Array = None,
    setpoint_rate: Array = None,
    setpoint_acceleration: Array = None,
    feedforward: Array = None,
) -> tuple[PIDState, Terms]:
    """Advance the law in accelerations and return efforts; otherwise as :func:`batchpid.advance`.

    Parameters
    ----------
    mass_matrix
        (envs, joints, joints) at about the present positions [kg m^2 or kg].
    setpoint_acceleration
        r'' (envs, joints), added to the acceleration of the law [rad/s^2 or m/s^2].
    feedforward
        Effort added to the effort of the law [N m or N]: passive force and more.
    """
    mass_matrix, feedforward, setpoint_acceleration = in_dtype_of(
        k, mass_matrix, feedforward, setpoint_acceleration
    )
    rates = measurement_rate, setpoint_rate, given_acceleration(k, setpoint_acceleration)
    new, terms = advance(_unlimited(k), state, setpoint, measurement, *rates)
    new, effort, unsaturated = _to_effort(
        k,
        state,
        new,
        terms.effort,
        mass_matrix,
        feedforward,
    )
    p, i, d, arguments = (
        x if isinstance(x, float) else matrix_vector(mass_matrix, x) for x in terms[:4]
    )
    if feedforward is not None:
        arguments = arguments + feedforward
    return new, Terms(
        p,
        i,
        d,
        arguments,
        unsaturated,
        effort,
    )


def given_acceleration(k: Coefficients, setpoint_acceleration: Array) -> Array:
    """Return the term of a given setpoint acceleration in the law's output; None without one."""
    if setpoint_acceleration is None or k.acceleration_share is None:
        return setpoint_acceleration
    return k.acceleration_share * setpoint_acceleration


def check_gain_units(params: PIDParams) -> None:
    """Raise InvalidArgumentError for back-calculation with gain_units "mass_matrix": it has no
    meaning for accelerations.
    """
    if isinstance(params.gain_units, PerMassMatrix) and params.tracking_time is not None:
        problem = "'back_calculation' is not available with gain_units 'mass_matrix'"
        remedy = "use anti_windup 'conditional', or gain_units 'effort'"
        raise InvalidArgumentError("anti_windup", problem, remedy=remedy)


def _unlimited(k: Coefficients) -> Coefficients:
    return k._replace(
        effort_min=None,
        effort_max=None,
        effort_step=None,
        gain_units=None,
    )


def _to_effort(
    k: Coefficients,
    old: PIDState,
    new: PIDState,
    a: Array,
    mass_matrix: Array,
    feedforward: Array,
) -> tuple[PIDState, Array, Array]:
    """Return the state, the effort of the acceleration ``a`` within the limits of ``k``, and
    without them.
    """
    xp = namespace(*k, a, mass_matrix)
    low = k.effort_min
    high = k.effort_max
    demand = matrix_vector(mass_matrix, a)
    passive = 0.0 if feedforward is None else feedforward
    effort = unsaturated = demand + passive
    stops = k.ki_dt is not None and isinstance(k.anti_windup, Conditional)
    change = new.integral - old.integral if stops else None
    deeper = None
    if low is not None or high is not None:
        # The acceleration is scaled as a whole, so that its direction stays.
        share = _share(demand, passive, low, high, xp)
        effort = clip(share * demand + passive, low, high, xp)
        if change is None:
            deeper = None
        else:
            deeper = (share < 1) & (a * change > 0)
    if k.effort_step is not None:
        reached = effort
        effort = clip(reached, old.effort - k.effort_step, old.effort + k.effort_step, xp)
        effort = clip(effort, low, high, xp)
        new = new._replace(effort=effort.copy())
        if change is None:
            late = None
        else:
            late = (reached - effort) * change > 0
        deeper = late if deeper is None else deeper | late
    if deeper is not None:
        new = new._replace(integral=xp.where(deeper, old.integral, new.integral))
    return new, effort, unsaturated


def _share(
    demand: Array,
    passive: Array,
    low: Array,
    high: Array,
    xp: ArrayModule,
) -> Array:
    """Return s (envs, 1): the share of ``demand`` that fits between ``passive`` and the limits."""
    above = xp.inf if high is None else high - passive
    below = xp.inf if low is None else passive - low
    room = xp.where(demand > 0, above, below)
    size = xp.abs(demand)
    limited = (size > room) & (room > 0)
    return row_minimum(xp.where(limited, room / xp.where(limited, size, 1.0), 1.0))
