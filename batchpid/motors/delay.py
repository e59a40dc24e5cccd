r"""Delay of sampled signals by any time, interpolated between samples.

With samples x_k at t = k dt, and a delay d = (n + f) dt with whole n and 0 <= f < 1::

    y_k = (1 - f) x_{k-n} + f x_{k-n-1}

A sine of angular frequency w is delayed by d exactly at f = 0, and by d to second order in w dt
otherwise, with its amplitude lowered by at most the factor cos(w dt / 2) (T. I. Laakso et al.,
"Splitting the unit delay", IEEE Signal Processing Magazine 13, 1996: linear interpolation is the
Lagrange filter of order 1).
"""

from __future__ import annotations

import math

from batchpid.arrays.array_types import Array, ArrayModule
from batchpid.arrays.elementwise import namespace, take_rows, wrap
from batchpid.checks import is_traced
from batchpid.errors import InvalidArgumentError

MOST_SAMPLES = 20_000
_NEAR = 1e-5  # steps: a delay that is a whole number of steps but for rounding is one


Delay = tuple[Array, Array]
"""A delay at one time step, for histories (..., samples, joints): n (1 | envs, joints), and f
(1 | envs, joints) or None for 0 everywhere.
"""


def samples_of(longest: Array, dt: float) -> int:
    """Return the samples that a history needs for delays up to ``longest`` (1, 1) [s].

    Raises InvalidArgumentError if it is traced by JAX, so that its size is not known, or it needs
    too many samples.
    """
    if is_traced(longest) or is_traced(dt):
        raise InvalidArgumentError(
            "max_delay", "is traced: its value is unknown", remedy="pass samples= to init"
        )
    seconds = float(longest.item())
    count = math.floor(seconds / dt + _NEAR) + 2
    if count > MOST_SAMPLES:
        remedy = f"use a longer time step, or delays of at most {(MOST_SAMPLES - 2) * dt:g} s"
        raise InvalidArgumentError(
            "max_delay", f"needs {count} samples", value=seconds, remedy=remedy
        )
    return count


def discretise(delay: Array, dt: Array, samples: int) -> Delay:
    """Return ``delay`` (1 | envs, joints) [s] in steps of ``dt`` [s], for histories of
    ``samples``; a longer one reads the oldest sample.
    """
    xp = namespace(delay)
    steps = delay / dt
    whole = xp.rint(steps)
    steps = xp.where(xp.abs(steps - whole) < _NEAR, whole, steps)
    steps = xp.minimum(steps, samples - 1)
    # One sample is left for the older neighbour of the interpolation.
    whole = xp.minimum(xp.floor(steps), samples - 2)
    fraction = steps - whole
    # Delays of whole steps need no interpolation.
    if not is_traced(fraction) and not fraction.any():
        return whole, None
    return whole, fraction


def start(value: Array, samples: int) -> Array:
    """Return a history (..., samples, joints) that has been ``value`` (..., joints) so far."""
    shape = *value.shape[:-1], samples, value.shape[-1]
    return namespace(value).broadcast_to(value[..., None, :], shape).copy()


def read(
    history: Array,
    k: Delay,
    turns: Array,
    xp: ArrayModule,
) -> Array:
    """Return the delayed value (..., joints); ``turns`` is 1 / (2 pi) where it is an angle, 0
    elsewhere, or None.
    """
    whole, fraction = k
    later = take_rows(history, whole)
    if fraction is None:
        return later
    return later + fraction * wrap(take_rows(history, whole + 1) - later, turns, xp)
