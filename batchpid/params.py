"""The parameters of the control law: build, broadcast, validate.

A :class:`PIDParams` is a ``NamedTuple`` of float arrays, hence a pytree that JAX knows without registration. An
option that is off is ``None``: it is no leaf, so NumPy skips it and ``jax.jit`` compiles a law without it. Choices
that carry no number (the integration order, say) are field-less marker tuples: part of the tree's structure and so
static under every JAX transform.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from batchpid.errors import InvalidArgumentError

ANTI_WINDUP = ("none", "clamp", "conditional", "back_calculation")


class Everywhere(NamedTuple):
    """Marker: an option that may be chosen per joint and env holds on all of them, so no mask is needed."""


class IntegrateFirst(NamedTuple):
    """Marker: the integral takes in the present error before the effort is computed."""


class DerivativeKick(NamedTuple):
    """Marker: the error before the first sample counts as 0, so the first derivative is a kick (peers do it)."""


class WeightFromStart(NamedTuple):
    """Marker: setpoint weighting measures positions from the first measurement instead of from 0."""


class ZeroEffort(NamedTuple):
    """Marker: a joint with a non-finite input gets effort 0."""


class HoldEffort(NamedTuple):
    """Marker: a joint with a non-finite input gets its last effort again."""


MARKERS = (Everywhere, IntegrateFirst, DerivativeKick, WeightFromStart, ZeroEffort, HoldEffort)
CHOICES: dict[str, dict[str, Any]] = {
    "integration": {"output_first": None, "integrate_first": IntegrateFirst()},
    "first_derivative": {"zero": None, "kick": DerivativeKick()},
    "weight_origin": {"zero": None, "start": WeightFromStart()},
    "non_finite": {"propagate": None, "zero": ZeroEffort(), "hold": HoldEffort()},
}
"""Options chosen by name, and the marker that each name puts into the params (the first is the default)."""


class PIDParams(NamedTuple):
    """Parameters of the law. Every leaf is a float array, (1, joints) or (envs, joints); None is off.

    Build it with :func:`make_params`, which validates. Inside a traced function use ``params._replace(kp=...)``
    with arrays of these shapes.
    """

    kp: Any
    """Proportional gain, effort / position."""
    ki: Any = None
    """Integral gain, effort / (position s)."""
    kd: Any = None
    """Derivative gain, effort s / position."""
    effort_min: Any = None
    """Lowest total effort [N m or N]."""
    effort_max: Any = None
    """Highest total effort [N m or N]."""
    effort_rate_limit: Any = None
    """Largest change of the effort per second."""
    integral_min: Any = None
    """Lowest integral term, in effort units."""
    integral_max: Any = None
    """Highest integral term, in effort units."""
    derivative_filter_time: Any = None
    """Time constant of the derivative's low-pass [s]."""
    setpoint_weight: Any = None
    """b: weight of the setpoint in the proportional term (off: 1)."""
    setpoint_weight_derivative: Any = None
    """c: weight of the setpoint in the derivative term (off: 0)."""
    deadband: Any = None
    """Half width of the error's dead zone [rad or m]."""
    tracking_time: Any = None
    """Back-calculation's time constant [s]; inf on a joint without it."""
    conditional: Any = None
    """Conditional integration: Everywhere(), or 1.0 on the joints that have it."""
    continuous: Any = None
    """1.0 on the joints whose position is an angle modulo 2 pi."""
    integration: IntegrateFirst | None = None
    """Off: the effort is computed first, with the integral of the past errors."""
    first_derivative: DerivativeKick | None = None
    """Off: the derivative of the first sample is 0."""
    weight_origin: WeightFromStart | None = None
    """Off: setpoint weighting takes positions as they are."""
    non_finite: ZeroEffort | HoldEffort | None = None
    """Off: what is not finite propagates."""

    @property
    def joints(self) -> int:
        """Number of joints."""
        return int(self.kp.shape[-1])

    @property
    def num_envs(self) -> int:
        """Number of envs that the params tell apart: 1 when all envs share them."""
        return max(leaf.shape[-2] for leaf in self if _is_array(leaf))

    @property
    def dtype(self) -> Any:
        """The dtype of every leaf."""
        return self.kp.dtype

    def for_envs(self, envs: slice | Any) -> PIDParams:
        """Return the params of some envs (a slice or an index array); shared rows stay shared."""
        return PIDParams(*(leaf[envs] if _is_array(leaf) and leaf.shape[0] > 1 else leaf for leaf in self))


def make_params(
    joints: int,
    kp: Any,
    ki: Any = None,
    kd: Any = None,
    *,
    effort_limit: Any = None,
    effort_min: Any = None,
    effort_max: Any = None,
    effort_rate_limit: Any = None,
    integral_limit: Any = None,
    integral_min: Any = None,
    integral_max: Any = None,
    derivative_filter_time: Any = None,
    setpoint_weight: Any = None,
    setpoint_weight_derivative: Any = None,
    deadband: Any = None,
    anti_windup: str | Sequence[Any] = "none",
    tracking_time: Any = None,
    continuous: Any = None,
    integration: str = "output_first",
    first_derivative: str = "zero",
    weight_origin: str = "zero",
    non_finite: str = "propagate",
    joint_names: Sequence[str] | None = None,
    dtype: Any = np.float64,
) -> PIDParams:
    """Build validated :class:`PIDParams`; a number may be a scalar, (joints,) or (envs, joints).

    ``None`` is off. A value that changes nothing anywhere (an infinite limit, a filter time of 0, a deadband of 0,
    weights b = 1 and c = 0) is off too. A gain of 0 stays: it can be tuned, and an integral of gain 0 can carry
    the bias of :func:`batchpid.track`.

    Parameters
    ----------
    joints
        Number of joints.
    kp, ki, kd
        Gains >= 0, in effort per position, per position and second, and per position/second.
    effort_limit, effort_min, effort_max
        Limits of the *total* effort [N m or N]: ``effort_limit=x`` is ``effort_min=-x, effort_max=x``.
    effort_rate_limit
        Largest change of the effort per second, > 0. The first step may go this far from an effort of 0.
    integral_limit, integral_min, integral_max
        Limits of the integral term, in effort units.
    derivative_filter_time
        Time constant of the derivative's first-order low-pass [s]; 0: unfiltered.
    setpoint_weight, setpoint_weight_derivative
        b and c: the proportional term acts on b*setpoint - measurement, the derivative on c*setpoint - measurement.
    deadband
        Half width of the zone around zero error in which P and I see no error; outside, its distance to the zone.
    anti_windup
        "none", "clamp" (limit the integral, to the effort limits unless integral limits are given), "conditional"
        (do not integrate further into saturation) or "back_calculation"; or a nested list of these of shape
        (joints,) or (envs, joints).
    tracking_time
        Back-calculation's time constant [s]; steps shorter than it are needed for more than a one-step correction.
        None: sqrt(kd/ki), or kp/ki without kd (K. J. Astrom and T. Hagglund, Advanced PID Control, 2006, sec. 3.5).
    continuous
        Bools: joints whose position is an angle modulo 2 pi [rad]; errors and differences take the short way round.
    integration
        "output_first" (control_toolbox) or "integrate_first" (simple-pid, Newton).
    first_derivative
        "zero", or "kick": the error before the first sample counts as 0 (for parity with peers).
    weight_origin
        "zero", or "start": setpoint weighting measures positions from the first measurement.
    non_finite
        What to do with a joint whose input is NaN or inf: "propagate" it (no check, no cost), or keep the state and
        command "zero" effort, or "hold" the last effort.
    joint_names
        Used in error messages.
    dtype
        float32 or float64.

    Raises
    ------
    InvalidArgumentError
        Naming the option, joint, env and value.
    """
    build = _Builder(joints, joint_names, dtype)
    if kp is None:
        raise InvalidArgumentError("kp", "is missing", remedy="give the proportional gain, 0 for none")
    inf = math.inf
    p, i, d = (build.array(n, v, 0.0) for n, v in (("kp", kp), ("ki", ki), ("kd", kd)))
    lowest, highest = build.limits("effort", effort_limit, effort_min, effort_max)
    integral_lowest, integral_highest = build.limits("integral", integral_limit, integral_min, integral_max)
    clamp, conditional, back = build.strategies(anti_windup)
    if clamp is not None:
        if integral_lowest is None and integral_highest is None:
            integral_lowest, integral_highest = lowest, highest
            if lowest is None and highest is None:
                raise InvalidArgumentError(
                    "anti_windup",
                    "'clamp' has no limit to clamp the integral to",
                    remedy="give integral_limit or effort_limit",
                )
            integral_lowest = None if lowest is None else np.where(clamp, lowest, -inf)
            integral_highest = None if highest is None else np.where(clamp, highest, inf)
    tracking = None
    if back is not None:
        tracking = build.array("tracking_time", tracking_time, 0.0, inf)
        tracking = _rule_of_thumb(p, i, d) if tracking is None else tracking
        tracking = np.where(back, tracking, inf)
    elif tracking_time is not None:
        raise InvalidArgumentError(
            "tracking_time",
            "is given, but no joint has anti_windup 'back_calculation'",
            remedy="choose that strategy or leave tracking_time out",
        )
    wraps = build.mask("continuous", continuous)
    markers = {
        name: build.choice(name, chosen)
        for name, chosen in (
            ("integration", integration),
            ("first_derivative", first_derivative),
            ("weight_origin", weight_origin),
            ("non_finite", non_finite),
        )
    }
    if conditional is not None:
        conditional = Everywhere() if conditional.all() else build.freeze(conditional)
    return PIDParams(
        kp=build.freeze(p),
        ki=build.freeze(i),
        kd=build.freeze(d),
        effort_min=build.freeze(lowest),
        effort_max=build.freeze(highest),
        effort_rate_limit=build.option("effort_rate_limit", effort_rate_limit, neutral=inf, above=True),
        integral_min=build.freeze(integral_lowest),
        integral_max=build.freeze(integral_highest),
        derivative_filter_time=build.option("derivative_filter_time", derivative_filter_time, neutral=0.0),
        setpoint_weight=build.option("setpoint_weight", setpoint_weight, neutral=1.0),
        setpoint_weight_derivative=build.option(
            "setpoint_weight_derivative", setpoint_weight_derivative, neutral=0.0
        ),
        deadband=build.option("deadband", deadband, neutral=0.0),
        tracking_time=build.freeze(tracking),
        conditional=conditional,
        continuous=build.freeze(wraps),
        **markers,
    )


def _is_array(leaf: Any) -> bool:
    """Whether this entry of a params tuple is a leaf (neither off nor a marker)."""
    return leaf is not None and not isinstance(leaf, tuple)


def _rule_of_thumb(kp: Any, ki: Any, kd: Any) -> Any:
    """Tt = sqrt(Ti Td) = sqrt(kd/ki), or Ti = kp/ki without kd; inf (no correction) where nothing is integrated."""
    if ki is None:
        return np.full_like(kp, math.inf)
    kd = np.zeros_like(kp) if kd is None else kd
    kp, ki, kd = np.broadcast_arrays(kp, ki, kd)
    safe = np.where(ki > 0, ki, 1.0)
    return np.where(ki > 0, np.where(kd > 0, np.sqrt(kd / safe), kp / safe), math.inf)


class _Builder:
    """Turns what the caller gave into canonical arrays, and complaints into errors that name the culprit."""

    def __init__(self, joints: int, joint_names: Sequence[str] | None, dtype: Any) -> None:
        if isinstance(joints, bool) or not isinstance(joints, int | np.integer) or joints < 1:
            raise InvalidArgumentError(
                "joints", "is not a whole number >= 1", value=joints, remedy="give the number of joints"
            )
        if joint_names is not None and len(joint_names) != joints:
            raise InvalidArgumentError(
                "joint_names", f"names {len(joint_names)} joints, not {joints}", remedy="name every joint once"
            )
        self.joints, self.names = int(joints), joint_names
        self.dtype = np.dtype(dtype)
        if self.dtype not in (np.float32, np.float64):
            raise InvalidArgumentError(
                "dtype", "is neither float32 nor float64", value=str(dtype), remedy="choose one of them"
            )
        self.num_envs = 1

    def array(self, name: str, value: Any, low: float, high: float = math.nan, above: bool = False) -> Any:
        """Return ``value`` as (1 | envs, joints) with every entry in [low, high]; ``high`` NaN: finite only."""
        if value is None:
            return None
        try:
            array = np.asarray(value)
            if array.dtype.kind not in "iuf":
                raise TypeError
            array = array.astype(self.dtype)
        except (TypeError, ValueError):
            raise InvalidArgumentError(
                name, "is not made of real numbers", value=value, remedy="give numbers"
            ) from None
        array = self._canonical(name, array)
        within = np.isfinite(array) if math.isnan(high) else array <= high
        within &= (array > low) if above else (array >= low)
        if not within.all():
            env, joint = (int(n) for n in np.argwhere(~within)[0])
            bounds = f"{'>' if above else '>='} {low:g}" if math.isfinite(low) else "a number"
            raise InvalidArgumentError(
                name,
                f"must be {'finite and ' if math.isnan(high) else ''}{bounds}",
                joint=self.names[joint] if self.names is not None else joint,
                env=env if array.shape[0] > 1 else None,
                value=float(array[env, joint]),
                remedy="correct that entry",
            )
        return array

    def option(self, name: str, value: Any, *, neutral: float, above: bool = False) -> Any:
        """Return an option's leaf: None where it is ``neutral`` on every joint of every env."""
        array = self.array(name, value, 0.0, math.inf if math.isinf(neutral) else math.nan, above)
        return None if array is None or (array == neutral).all() else self.freeze(array)

    def limits(self, name: str, symmetric: Any, low: Any, high: Any) -> tuple[Any, Any]:
        """Return the leaves of a lower and an upper limit, each None where it is infinite everywhere."""
        if symmetric is not None:
            if low is not None or high is not None:
                raise InvalidArgumentError(
                    f"{name}_limit",
                    f"is given together with {name}_min or {name}_max",
                    remedy="give the symmetric limit, or the two ends",
                )
            upper = self.array(f"{name}_limit", symmetric, 0.0, math.inf)
            lower = -upper
        else:
            lower = self.array(f"{name}_min", low, -math.inf, math.inf)
            upper = self.array(f"{name}_max", high, -math.inf, math.inf)
        if lower is not None and upper is not None and not (lower <= upper).all():
            env, joint = (int(n) for n in np.argwhere(~(lower <= upper))[0])
            raise InvalidArgumentError(
                f"{name}_min",
                f"exceeds {name}_max",
                joint=self.names[joint] if self.names is not None else joint,
                env=env if max(lower.shape[0], upper.shape[0]) > 1 else None,
                remedy="swap or correct them",
            )
        lower = None if lower is None or np.isneginf(lower).all() else lower
        upper = None if upper is None or np.isposinf(upper).all() else upper
        return lower, upper

    def mask(self, name: str, value: Any) -> Any:
        """Return a mask of 1.0 and 0.0, None where it is False everywhere."""
        if value is None:
            return None
        array = np.asarray(value)
        if array.dtype.kind != "b":
            raise InvalidArgumentError(name, "is not made of bools", value=value, remedy="give True or False")
        array = self._canonical(name, array)
        return array.astype(self.dtype) if array.any() else None

    def strategies(self, value: Any) -> tuple[Any, Any, Any]:
        """Return the masks of clamp, conditional and back-calculation, each None where no joint has it."""
        array = self._canonical("anti_windup", np.asarray(value, dtype=object))
        for env, joint in np.ndindex(array.shape):
            if not isinstance(array[env, joint], str) or array[env, joint] not in ANTI_WINDUP:
                raise InvalidArgumentError(
                    "anti_windup",
                    "is no known strategy",
                    joint=self.names[joint] if self.names is not None else joint,
                    env=env if array.shape[0] > 1 else None,
                    value=array[env, joint],
                    remedy=f"choose from {', '.join(ANTI_WINDUP)}",
                )
        masks = (array == strategy for strategy in ANTI_WINDUP[1:])
        clamp, conditional, back = (mask if mask.any() else None for mask in masks)
        return clamp, conditional, back

    def choice(self, name: str, chosen: Any) -> Any:
        """Return the marker of a named choice."""
        if not isinstance(chosen, str) or chosen not in CHOICES[name]:
            raise InvalidArgumentError(
                name, "is no known choice", value=chosen, remedy=f"choose from {', '.join(CHOICES[name])}"
            )
        return CHOICES[name][chosen]

    def freeze(self, array: Any) -> Any:
        """Return the leaf in the params' dtype and read-only: params are values, to be replaced and not edited."""
        if array is None:
            return None
        leaf = np.array(array, dtype=self.dtype)
        leaf.setflags(write=False)
        return leaf

    def _canonical(self, name: str, array: Any) -> Any:
        """Return a scalar, (joints,) or (envs, joints) as (1 | envs, joints)."""
        if array.ndim <= 1 and array.size and array.shape in ((), (1,), (self.joints,)):
            return np.broadcast_to(array, (1, self.joints)).copy()
        if array.ndim == 2 and array.shape[1] in (1, self.joints) and array.shape[0] >= 1:
            envs = array.shape[0]
            if envs == 1 or self.num_envs in (1, envs):
                self.num_envs = max(self.num_envs, envs)
                return np.broadcast_to(array, (envs, self.joints)).copy()
            expected = f"({self.num_envs}, {self.joints}), as another option has it"
        else:
            expected = f"(), ({self.joints},) or (envs, {self.joints})"
        raise InvalidArgumentError(
            name, f"has shape {array.shape}, not {expected}", remedy="give one value, or one per joint, or one per env and joint"
        )
