r"""Figures of merit of step responses, as in the control literature, batched over (envs, joints).

With setpoint r, start y0, move A = r - y0 and error e = r - y, per env and joint::

    overshoot            max((y - r) sign A) / |A|, at least 0
    settling time        from which on |e| <= max(2 % |A|, absolute band)
    steady-state error   max |e| over the last tenth of the record
    ITAE                 int t |e| dt
    effort variation     sum |u_k - u_{k-1}|: chatter of the actuator
    saturation share     of the samples

Overshoot and settling time as in K. J. Astrom and R. M. Murray, Feedback Systems
(Princeton, 2nd ed.), section 6.3; ITAE after D. Graham and R. C. Lathrop, "The synthesis of optimum
transient response", Trans. AIEE 72 (1953); total variation of the effort after S. Skogestad,
"Simple analytic rules for model reduction and PID controller tuning", J. Process Control 13 (2003).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from batchpid.arrays.array_types import Float64, Rows
from batchpid.arrays.elementwise import TURN
from batchpid.arrays.records import array_summary
from batchpid.checks import broadcast, read_array, time_step
from batchpid.errors import InvalidArgumentError

SETTLING_SHARE = 0.02
"""Half width of the settling band, as a share of the move."""
FINAL_SHARE = 0.1
"""Last share of the record, over which the steady-state error is taken."""


class StepMetrics(NamedTuple):
    """Figures of merit of a step response, each (envs, joints); lower is better.

    A time that is not reached, and every figure of a joint that was not finite throughout, is inf.
    An undefined figure (overshoot of a joint that hardly moves, effort figures without efforts) is
    NaN.
    """

    overshoot: Float64
    """Largest excursion beyond the setpoint, as a fraction of the move."""
    settling_time: Float64
    """Time after which the error stays within the band [s]."""
    steady_state_error: Float64
    """Largest absolute error over the last tenth of the record [rad or m]."""
    peak_deviation: Float64
    """Largest distance beyond the setpoint, defined without a move too [rad or m]."""
    itae: Float64
    """Integral of time times the absolute error [rad s^2 or m s^2]."""
    effort_variation: Float64
    """Total variation of the effort [N m or N], which is large where it chatters."""
    saturation_share: Float64
    """Share of samples in saturation."""

    def __repr__(self) -> str:
        return array_summary(self)


@np.errstate(divide="ignore", invalid="ignore")
def step_metrics(
    dt: float,
    setpoint: ArrayLike,
    measurement: ArrayLike,
    *,
    start: ArrayLike | None = None,
    effort: ArrayLike | None = None,
    saturated: ArrayLike | None = None,
    absolute_band: ArrayLike = 1e-3,
    continuous: ArrayLike | None = None,
) -> StepMetrics:
    """Return the figures of merit of step responses.

    Parameters
    ----------
    dt
        Time between samples [s]. The step is at 0: at the first sample, or with ``start`` one dt
        before it.
    setpoint
        (joints,), (envs, joints) or (ticks, envs, joints) [rad or m]; the last row is where the
        move ends, the errors of ITAE are to each row's own.
    measurement
        (ticks, envs, joints) [rad or m].
    start
        (envs, joints) or (joints,): start of the move; default the first row of ``measurement``.
    effort, saturated
        (ticks, envs, joints): applied efforts [N m or N], and whether they were limited.
    absolute_band
        Least half width of the settling band [rad or m], a number or (joints,). The overshoot is
        undefined for moves smaller than 50 times that, where it would compare noise with noise.
    continuous
        (joints,) bool: positions that are angles modulo 2 pi; the move is the short way round.

    Raises
    ------
    InvalidArgumentError
        Shapes that do not fit, fewer than two samples, or a dt out of range.
    """
    y = read_array("measurement", measurement).astype(np.float64)
    if y.ndim != 3 or len(y) < 2:
        problem = f"has shape {y.shape}, needs (ticks, envs, joints) with at least 2 ticks"
        raise InvalidArgumentError("measurement", problem, remedy="pass a rollout's qpos")
    # Everything takes the shape of the measurement.
    r = broadcast("setpoint", setpoint, y.shape)
    floor = broadcast("absolute_band", absolute_band, y.shape[1:])
    u = broadcast("effort", np.nan if effort is None else effort, y.shape)
    # Without efforts the figures are NaN; with a NaN among the efforts they lose every comparison.
    is_sound = np.isfinite(u).all(0) | (effort is None)
    if saturated is None:
        limited: Rows = np.full(y.shape, np.nan)
    else:
        limited = read_array("saturated", saturated, "b")
    if start is not None:
        y = np.concatenate([broadcast("start", start, y.shape[1:])[None], y])
        r = np.concatenate([r[:1], r])
    t = time_step("dt", dt) * np.arange(len(y), dtype=np.float64)
    # A joint with a NaN gets figures of inf, by judged() below: it must lose every comparison, not
    # drop out of it.
    finite = np.isfinite(y).all(0) & np.isfinite(r).all(0)
    y = np.where(finite, y, 0.0)
    r = np.where(finite, r, 0.0)
    if continuous is not None:
        y, r = _unwrap(y, r, read_array("continuous", continuous, "b"))

    # Figures of a move refer to where it ends, integrals to each row's own setpoint.
    move = r[-1] - y[0]
    size = np.abs(move)
    direction = np.where(move < 0, -1.0, 1.0)
    error = r - y
    final_error = r[-1] - y
    tolerance: Float64 = np.maximum(SETTLING_SHARE * size, floor)
    # For a joint that hardly moves, overshoot would measure noise; its deviation is still reported.
    moves = size >= floor / SETTLING_SHARE
    beyond = np.where(
        moves,
        np.max(-final_error * direction, 0),
        np.max(np.abs(final_error), 0),
    )
    beyond = np.maximum(beyond, 0.0)
    overshoot = np.where(moves, beyond / size, np.nan)
    tail_rows = max(1, round(FINAL_SHARE * len(t)))

    def judged(figure: ArrayLike) -> Float64:
        return np.where(finite, figure, np.inf)

    return StepMetrics(
        overshoot=judged(overshoot),
        settling_time=judged(_settling_time(t, final_error, tolerance)),
        steady_state_error=judged(np.abs(error[-tail_rows:]).max(0)),
        peak_deviation=judged(beyond),
        itae=judged(
            np.trapezoid(
                t[:, None, None] * np.abs(error),
                t,
                axis=0,
            )
        ),
        effort_variation=np.where(
            is_sound,
            np.abs(np.diff(u, axis=0)).sum(0),
            np.inf,
        ),
        saturation_share=np.mean(limited, axis=0),
    )


def _settling_time(t: Float64, error: Float64, tolerance: Float64) -> Float64:
    """Return when ``error`` last enters the band, between samples by a line; inf if it ends
    outside.
    """
    outside = np.abs(error) > tolerance
    last = len(t) - 1 - np.argmax(outside[::-1], 0)
    k = np.minimum(last, len(t) - 2)
    before = _row(error, k)
    after = _row(error, k + 1)
    edge = np.copysign(tolerance, before)
    share = np.clip((edge - before) / (after - before), 0.0, 1.0)
    settled = np.where(
        outside[-1],
        np.inf,
        t[k] + share * (t[k + 1] - t[k]),
    )
    return np.where(outside.any(0), settled, 0.0)


def _row(table: Float64, k: Rows) -> Float64:
    """Return ``table[k]`` for an index k per env and joint."""
    values: Float64 = np.take_along_axis(table, k[None], 0)[0]
    return values


def _unwrap(y: Float64, r: Float64, continuous: NDArray[np.bool_]) -> tuple[Float64, Float64]:
    """Return angles without jumps, and the setpoint nearest to the start."""
    course = np.unwrap(y, axis=0)
    target = np.unwrap(r, axis=0)
    target = target - TURN * np.rint((target[-1] - course[0]) / TURN)
    return np.where(continuous, course, y), np.where(continuous, target, r)
