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

from batchpid.choices import CHOICES, Everywhere
from batchpid.errors import InvalidArgumentError
from batchpid.options import LeafBuilder


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
    integration: Any = None
    """IntegrateFirst(); off: the effort is computed first, with the integral of the past errors."""
    first_derivative: Any = None
    """DerivativeKick(); off: the derivative of the first sample is 0."""
    weight_origin: Any = None
    """WeightFromStart(); off: setpoint weighting takes positions as they are."""
    non_finite: Any = None
    """ZeroEffort() or HoldEffort(); off: what is not finite propagates."""
    measurement_rate: Any = None
    """MeasuredRate(), for who runs the law on a robot: give it the measured rate; off: differences of measurements."""
    gain_units: Any = None
    """PerInertia() or PerMassMatrix(), for who runs the law on a robot; off: the gains give efforts."""

    @property
    def num_joints(self) -> int:
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

    def options(self) -> dict[str, Any]:
        """Return the options that are on, as arguments of :func:`make_params` that build these params again.

        "clamp" shows as the integral limits it stands for.
        """
        options: dict[str, Any] = {}
        for name, leaf in zip(self._fields, self, strict=True):
            if name in CHOICES:
                (options[name],) = (n for n, marker in CHOICES[name].items() if type(marker) is type(leaf))
            elif _is_array(leaf) and name != "conditional":
                options[name] = np.array(leaf)
        if self.continuous is not None:
            options["continuous"] = options["continuous"] > 0
        strategy = np.full((1, self.num_joints), "none", dtype=object)
        if self.tracking_time is not None:
            strategy = np.where(np.isfinite(options["tracking_time"]), "back_calculation", strategy)
        if self.conditional is not None:
            everywhere = isinstance(self.conditional, Everywhere)
            chosen = np.array(True) if everywhere else np.asarray(self.conditional) > 0
            strategy = np.where(chosen, "conditional", strategy)
        return {**options, "anti_windup": strategy, "dtype": np.dtype(self.dtype)}

    def replace(self, **options: Any) -> PIDParams:
        """Return params with some options of :func:`make_params` changed, checked as there."""
        known = self.options()
        for end in ("effort", "integral"):
            if f"{end}_limit" in options:
                known.pop(f"{end}_min", None)
                known.pop(f"{end}_max", None)
        if "anti_windup" in options:
            known.pop("tracking_time", None)
        return make_params(self.num_joints, **{**known, **options})

    def check(self, num_envs: int, joint_names: Sequence[str] | None = None) -> None:
        """Raise InvalidArgumentError unless every leaf is right for (num_envs, joints): for edits by hand."""
        expected = f"(1, {self.num_joints}) or ({num_envs}, {self.num_joints})"
        for name, leaf in zip(self._fields, self, strict=True):
            if not _is_array(leaf):
                continue
            array = np.asarray(leaf)
            if array.shape not in ((1, self.num_joints), (num_envs, self.num_joints)):
                raise InvalidArgumentError(
                    f"params.{name}",
                    f"has shape {array.shape}, not {expected}",
                    remedy="slice or rebuild the params",
                )
            if array.dtype != self.dtype:
                raise InvalidArgumentError(
                    f"params.{name}", f"is {array.dtype}, but kp is {self.dtype}", remedy="use one dtype"
                )
            bad = np.isnan(array) if name in _SIGNED else ~(array >= 0)
            if bad.any():
                env, joint = (int(n) for n in np.argwhere(bad)[0])
                raise InvalidArgumentError(
                    f"params.{name}",
                    "is NaN" if name in _SIGNED else "is negative or NaN",
                    joint=joint if joint_names is None else joint_names[joint],
                    env=env if array.shape[0] > 1 else None,
                    value=float(array[env, joint]),
                    remedy="correct that entry",
                )


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
    measurement_rate: str = "difference",
    gain_units: str = "effort",
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
    measurement_rate
        Rate of the measurement that the derivative uses: "difference" of successive measurements, or "measured": the
        velocity that :class:`sim.Runner` reads from the simulator. A law that is given none differences.
    gain_units
        "effort" per position, ...; or per unit of "inertia", or of the whole "mass_matrix": gains of an acceleration,
        which :class:`sim.Runner` turns into an effort at the robot's pose (see :mod:`batchpid.computed_torque`).
    joint_names
        Used in error messages.
    dtype
        float32 or float64.

    Raises
    ------
    InvalidArgumentError
        Naming the option, joint, env and value.
    """
    build = LeafBuilder(joints, joint_names, dtype)
    if kp is None:
        raise InvalidArgumentError("kp", "is missing", remedy="give the proportional gain, 0 for none")
    inf = math.inf
    p, i, d = (build.array(n, v, 0.0) for n, v in (("kp", kp), ("ki", ki), ("kd", kd)))
    lowest, highest = build.limits("effort", effort_limit, effort_min, effort_max)
    integral_lowest, integral_highest = build.limits("integral", integral_limit, integral_min, integral_max)
    clamp, conditional, back = build.strategies(anti_windup)
    if clamp is not None and integral_lowest is None and integral_highest is None:
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
        tracking = None if np.isinf(tracking).all() else tracking
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
            ("measurement_rate", measurement_rate),
            ("gain_units", gain_units),
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
        setpoint_weight_derivative=build.option("setpoint_weight_derivative", setpoint_weight_derivative, neutral=0.0),
        deadband=build.option("deadband", deadband, neutral=0.0),
        tracking_time=build.freeze(tracking),
        conditional=conditional,
        continuous=build.freeze(wraps),
        **markers,
    )


_SIGNED = ("effort_min", "effort_max", "integral_min", "integral_max")


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
