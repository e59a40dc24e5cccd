r"""Stability of a sampled PID loop on a chain of rigid bodies.

The simulator holds the effort u over a step dt and integrates semi-implicitly. Around a pose, with
the mass matrix M, implicit joint damping B, gains Kp, Kd and the derivative's filter time tau (all
diagonal but M)::

    (M + dt B) (v+ - v) = dt (u - B v),   q+ = q + dt v+,   u = -Kp q - Kd d,   d = (tau d' + q - q') / (tau + dt)

Put q_k = x z^k and multiply by x^H: for tau = 0, m (z - 1)^2 + b (z - 1) z + p z + c (z - 1) = 0,
where m, b, c and p are the positive numbers x^H M x, dt x^H B x, dt x^H Kd x and dt^2 x^H Kp x.
Jury's criterion asks for 2 c + p < 4 m + 2 b: the root that leaves the unit circle does so at z =
-1, where neighbouring samples alternate. There the filter passes dt / (dt + 2 tau) of the rate.
Over all x that is, by the largest eigenvalue of a symmetric matrix::

    ratio = 1/2 lambda_max( (M + dt/2 B)^-1 (dt/(dt + 2 tau) dt Kd + 1/2 dt^2 Kp) ) < 1

and ratio = 1 is the boundary, not only a bound on it. On one joint of inertia I without filter it
says kd dt / I + kp dt^2 / (2 I) < 2. On a chain it is the *coupled* inertia that counts: with axes
nearly in line (an arm stretched upright), joints that turn against each other move much less than
the diagonal of M says.

Where efforts or measurements are late, by a delay d and a first-order lag T, the loop becomes
unstable at a lower frequency. With the plant G(z) and the law C(z) of the equations above, the loop
and its limit are::

    L(z) = G(z) D(z) C(z),     ratio = max |lambda|     over the eigenvalues lambda of L(e^iw) with phase -180 degrees

because s times the gains are at the limit where s lambda = -1 (the generalised Nyquist criterion:
A. G. J. MacFarlane and I. Postlethwaite, "The generalized Nyquist stability criterion and
multivariable root loci", Int. J. Control 25, 1977). The phase has to fall through -180 degrees
there; if it begins below, no gains are stable and the ratio is infinite. A delay between two steps
is interpolated, as :mod:`batchpid.motors.delay` does.

The integral, which is slow, is not in the ratio. E. I. Jury, Theory and Application of the
z-Transform Method (Wiley, 1964).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from batchpid.arrays.array_types import Float64, Rows
from batchpid.checks import at_least, broadcast, read_array, time_step
from batchpid.errors import InvalidArgumentError

_FREQUENCIES = 100
"""Number of frequencies below and above 1 / 4 of the highest at which a late loop is evaluated;
between two of them the loci are interpolated.
"""
_SLOWEST = 0.01
"""Lowest of them, over 1 / (delay + lag)."""
_LATEST_STEPS = 1e9
"""Time steps of the longest delay and lag that the bound tells from longer ones."""


class StabilityBound(NamedTuple):
    """Share of the sampled loop's stability range that is used."""

    ratio: Float64
    """(...): below 1 the loop is stable, above 1 it diverges; without delay and lag with
    alternating signs from step to step.
    """
    participation: Float64
    """(..., joints): share of each joint in the least stable mode (with delay or lag: in its kinetic
    energy); sums to 1.
    """


def stability_bound(
    mass_matrix: ArrayLike,
    kp: ArrayLike,
    kd: ArrayLike,
    dt: float,
    *,
    filter_time: ArrayLike = 0.0,
    damping: ArrayLike = 0.0,
    delay: ArrayLike = 0.0,
    lag: ArrayLike = 0.0,
    model: ArrayLike | None = None,
) -> StabilityBound:
    """Return the distance of PD gains to the sampled loop's stability limit.

    Parameters
    ----------
    mass_matrix
        (..., joints, joints), symmetric and positive definite [kg m^2 or kg].
    kp, kd
        (joints,) or broadcastable to (..., joints): gains >= 0 [N m/rad or N/m, and times s].
    dt
        Control and simulation step [s].
    filter_time
        Time constant of the derivative's first-order low-pass [s], shaped as kp.
    damping
        Viscous damping of the joints, which the simulator integrates implicitly [N m s/rad or N
        s/m], shaped as kp.
    delay, lag
        Delay of efforts and measurements together, and time constant of the efforts' first-order
        lag [s], shaped as kp.
    model
        Mass matrix by which the law multiplies its output, where that is an acceleration, shaped as
        ``mass_matrix``. None: the output is an effort.

    Raises
    ------
    InvalidArgumentError
        A shape that does not fit, a mass matrix that is not positive definite, or a dt above 1 s.
    """
    m, p, c, tau, b, late, slow = _columns(
        mass_matrix,
        dt,
        kp=kp,
        kd=kd,
        filter_time=filter_time,
        damping=damping,
        delay=delay,
        lag=lag,
    )
    if model is not None or late.any() or slow.any():
        matrix = np.eye(m.shape[-1]) if model is None else model
        unit = broadcast("model", matrix, m.shape, "give it the shape of mass_matrix")
        at_least("model", unit, -np.inf)
        return _late_bound(m, unit, [p, c, tau, b, late, slow], dt)
    passed = dt / (dt + 2 * tau)
    weight = np.sqrt(passed * dt * c + 0.5 * dt**2 * p)
    implicit = 0.5 * dt * b[..., None] * np.eye(m.shape[-1])
    inverse = np.linalg.inv(m + implicit)
    values, vectors = np.linalg.eigh(weight[..., :, None] * inverse * weight[..., None, :])
    return StabilityBound(ratio=0.5 * values[..., -1], participation=vectors[..., -1] ** 2)


def _late_bound(
    m: Float64,
    unit: Float64,
    columns: list[Float64],
    dt: float,
) -> StabilityBound:
    """Return the bound of loops whose efforts are late; ``columns`` are as in :func:`_loop`, each
    (..., joints).
    """
    ratio = np.zeros(m.shape[:-2])
    participation = np.zeros(m.shape[:-1])
    for at in np.ndindex(*m.shape[:-2]):
        local = [column[at] for column in columns]
        # With later efforts z would round to 1 at the lowest frequency.
        local[-2:] = [np.minimum(late, _LATEST_STEPS * dt) for late in local[-2:]]
        # Frequencies are spaced by ratio where loci bend, and evenly up to the highest.
        latest = float(np.max(local[-2] + local[-1]))
        slowest = _SLOWEST / (1 + latest / dt)
        slow = np.geomspace(slowest, np.pi / 4, _FREQUENCIES)
        fast = np.linspace(np.pi / 4, np.pi, _FREQUENCIES)[1:]
        z = np.exp(1j * np.append(slow, fast))
        loop = _loop(z, m[at], unit[at], local, dt)
        ratio[at], row = _crossing(z, np.linalg.eigvals(loop))
        # Kinetic energy of the mode that passes -180 degrees at the ratio.
        values, modes = np.linalg.eig(loop[row])
        mode = modes[:, np.argmin(np.abs(values + ratio[at]))]
        energy = np.abs(mode * (m[at] @ mode))
        participation[at] = energy / energy.sum()
    return StabilityBound(ratio, participation)


def _loop(
    z: Rows,
    m: Float64,
    unit: Float64,
    columns: list[Float64],
    dt: float,
) -> Rows:
    """Return L (frequencies, joints, joints) of one loop at the points ``z`` (frequencies,) of the
    unit circle.

    ``columns`` are kp, kd, filter time, damping, delay and lag (joints,).
    """
    p, c, tau, b, delay, lag = columns
    entry = z[:, None]
    law = p + c * (entry - 1) / ((tau + dt) * entry - tau)
    whole = np.floor(delay / dt)
    part = delay / dt - whole
    intake = -np.expm1(-dt / np.maximum(lag, 1e-3 * dt))
    # Efforts are late by whole steps, by a part of one, and by the lag.
    delayed = entry**-whole * (1 - part + part / entry)
    late = delayed * intake / (1 - (1 - intake) / entry)
    implicit = b * np.eye(len(b))
    plant = (z - 1)[:, None, None] * m + dt * z[:, None, None] * implicit
    effort = late[..., None] * unit * law[:, None, :]
    moved: Rows = np.linalg.solve(plant, effort)
    response: Rows = moved * (dt**2 * z / (z - 1))[:, None, None]
    return response


def _crossing(z: Rows, values: Rows) -> tuple[float, int]:
    """Return the largest modulus at which a locus falls through -180 degrees, and the number of its
    frequency.

    ``values`` (frequencies, joints) are the eigenvalues of L at ``z``. The loci begin below the
    negative real axis where the loop is stable with small gains.
    """
    values = values.copy()
    values[-1] = values[-1].real  # at z = -1 it is real, but for rounding
    # Each eigenvalue goes on from the nearest one at the frequency before, apart from the fall of
    # all with frequency.
    local = values * np.abs(z - 1)[:, None] ** 2
    distance = np.abs(local[1:, :, None] - local[:-1, None, :])
    nearest = distance.argmin(2)
    now = np.take_along_axis(values[:-1], nearest, 1)
    then = values[1:]
    first = values[0]
    if ((first.real < 0) & (first.imag > 0)).any():
        return np.inf, 0
    is_negative = (now.real < 0) & (then.real < 0)
    falls = is_negative & (now.imag < 0) & (then.imag >= 0)
    # Between two frequencies the loci are straight.
    share = now.imag / np.where(falls, now.imag - then.imag, 1.0)
    crossed = np.where(
        falls,
        -now.real - share * (then.real - now.real),
        0.0,
    )
    return float(crossed.max()), int(crossed.max(1).argmax())


def _columns(mass_matrix: ArrayLike, dt: float, **columns: ArrayLike) -> tuple[Float64, ...]:
    """Return the mass matrix and the columns as (..., joints, joints) and (..., joints),
    checked.
    """
    time_step("dt", dt)
    m = read_array("mass_matrix", mass_matrix).astype(np.float64)
    if m.ndim < 2 or m.shape[-1] != m.shape[-2]:
        remedy = "pass shape (..., joints, joints)"
        raise InvalidArgumentError("mass_matrix", "is not square", value=m.shape, remedy=remedy)
    if not np.isfinite(m).all() or np.linalg.eigvalsh(m).min(initial=np.inf) <= 0:
        remedy = "check the masses and inertias of the robot's links"
        raise InvalidArgumentError("mass_matrix", "is not positive definite", remedy=remedy)
    return (
        m,
        *(
            at_least(name, broadcast(name, value, m.shape[:-1]), 0.0)
            for name, value in columns.items()
        ),
    )
