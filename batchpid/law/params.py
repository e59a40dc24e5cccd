"""The parameters of the control law: build, broadcast, validate.

A :class:`PIDParams` is a ``NamedTuple`` of float arrays, hence a pytree that JAX knows without
registration. An option that is off is ``None``, which is not a leaf: NumPy skips it and ``jax.jit``
compiles a law without it. Choices without a number, such as the unit of the gains, are tuples
without fields (:mod:`batchpid.arrays.choices`): part of the tree's structure, and so static under
every JAX transform.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Any, NamedTuple

import numpy as np

from batchpid.arrays.array_types import Array, Document, DType
from batchpid.arrays.choices import CHOICES, Everywhere, PerMassMatrix
from batchpid.arrays.display import array_summary
from batchpid.arrays.field_tables import Field, check_leaves, declared
from batchpid.arrays.leaves import LeafBuilder
from batchpid.checks.validate import is_traced, known_keywords
from batchpid.errors import InvalidArgumentError

PLAIN = (
    "effort_rate_limit",
    "derivative_filter_time",
    "setpoint_weight",
    "setpoint_weight_derivative",
    "deadband",
)
"""Options that become a leaf without regard to others."""


class PIDParams(NamedTuple):
    """Parameters of the law. Every leaf is a float array, (1, joints) or (envs, joints); None is
    off.

    Build it with :func:`make_params`, change it with :meth:`replace`: both validate, and both take
    traced gains. The fields have the meaning and the units of the options of :func:`make_params`;
    those with another form say so.
    """

    kp: Array
    ki: Array = None
    kd: Array = None
    effort_min: Array = None
    effort_max: Array = None
    effort_rate_limit: Array = None
    integral_min: Array = None
    integral_max: Array = None
    derivative_filter_time: Array = None
    setpoint_weight: Array = None
    setpoint_weight_derivative: Array = None
    deadband: Array = None
    tracking_time: Array = None
    """inf on a joint without back-calculation."""
    conditional: Any = None
    """Conditional integration: Everywhere(), or 1.0 on the joints that have it, 0.0 on the
    others.
    """
    continuous: Array = None
    """1.0 on the joints whose position is an angle modulo 2 pi, 0.0 on the others."""
    non_finite: Any = None
    """ZeroEffort() or HoldEffort(); off: non-finite values propagate."""
    measurement_rate: Array = None
    """MeasuredRate(): whoever runs the law on a robot gives it the measured rate; off: differences
    of measurements.
    """
    gain_units: Any = None
    """PerMassMatrix(): whoever runs the law on a robot converts to efforts; off: efforts."""
    discretization: Any = None
    """ImplicitLaw(): the law acts on the predicted end of the step; off: on its beginning."""

    @property
    def num_joints(self) -> int:
        """Number of joints."""
        return int(self.kp.shape[-1])

    @property
    def num_envs(self) -> int:
        """Number of envs with separate params; 1 where all envs share them."""
        return max(leaf.shape[-2] for leaf in self if _is_array(leaf))

    @property
    def dtype(self) -> DType:
        """Dtype of every leaf."""
        return self.kp.dtype

    def for_envs(self, envs: slice | Any) -> PIDParams:
        """Return the params of some envs (a slice or an index array); shared rows stay shared."""
        return PIDParams(
            *(leaf[envs] if _is_array(leaf) and leaf.shape[0] > 1 else leaf for leaf in self)
        )

    def for_joints(self, joints: Any) -> PIDParams:
        """Return the params of some joints (an index array or a mask)."""
        return PIDParams(*(leaf[:, joints] if _is_array(leaf) else leaf for leaf in self))

    def __repr__(self) -> str:
        return array_summary(self, "envs", "joints")

    def options(self) -> Document:
        """Return the options that are on, as arguments of :func:`make_params` that build these
        params again.

        "clamp" shows as the integral limits that it sets. Where its leaves are traced, anti_windup
        is left out.
        """
        options: Document = {}
        for name, leaf in zip(self._fields, self, strict=True):
            if name in CHOICES:
                (options[name],) = (
                    n for n, chosen in CHOICES[name].items() if type(chosen) is type(leaf)
                )
            elif _is_array(leaf) and name != "conditional":
                options[name] = leaf if is_traced(leaf) else np.array(leaf)
        if self.continuous is not None:
            options["continuous"] = options["continuous"] > 0
        if not is_traced(self.tracking_time) and not is_traced(self.conditional):
            strategy = np.full((1, self.num_joints), "none", dtype=object)
            if self.tracking_time is not None:
                strategy = np.where(np.isfinite(self.tracking_time), "back_calculation", strategy)
            if self.conditional is not None:
                everywhere = isinstance(self.conditional, Everywhere)
                strategy = np.where(
                    everywhere or np.asarray(self.conditional) > 0, "conditional", strategy
                )
            options["anti_windup"] = strategy
        return {**options, "dtype": np.dtype(self.dtype)}

    def replace(self, **options: Any) -> PIDParams:
        """Return params with some options of :func:`make_params` changed, checked as there."""
        known = self.options()
        for end in ("effort", "integral"):
            if f"{end}_limit" in options:
                known.pop(f"{end}_min", None)
                known.pop(f"{end}_max", None)
        if any(is_traced(value) for value in options.values()):
            del known["dtype"]
        if "anti_windup" in options or "anti_windup" not in known:
            known.pop("tracking_time", None)
        params = make_params(self.num_joints, **{**known, **options})
        if (
            "anti_windup" not in options and "anti_windup" not in known
        ):  # traced: the leaves are kept
            kept = {"tracking_time": self.tracking_time, "conditional": self.conditional}
            cast = {
                name: leaf.astype(params.dtype) if _is_array(leaf) else leaf
                for name, leaf in kept.items()
            }
            params = params._replace(**cast)
            params.check(params.num_envs)
        return params

    def check(self, num_envs: int, joint_names: Sequence[str] | None = None) -> None:
        """Raise InvalidArgumentError unless every leaf is right for (num_envs, joints): for edits
        by hand.
        """
        check_leaves("params", self, FIELDS, num_envs, joint_names)
        for name, leaf in zip(self._fields, self, strict=True):
            if _is_array(leaf) and leaf.dtype != self.dtype:
                problem = f"is {leaf.dtype}, but kp is {self.dtype}"
                raise InvalidArgumentError(f"params.{name}", problem, remedy="use one dtype")


@known_keywords
def make_params(
    joints: int,
    kp: Annotated[Array, Field("N m/rad or N/m")],
    ki: Annotated[Array, Field("N m/(rad s) or N/(m s)")] = None,
    kd: Annotated[Array, Field("N m s/rad or N s/m")] = None,
    *,
    effort_limit: Array = None,
    effort_min: Annotated[Array, Field("N m or N", -math.inf, low=-math.inf)] = None,
    effort_max: Annotated[Array, Field("N m or N", math.inf, low=-math.inf)] = None,
    effort_rate_limit: Annotated[Array, Field("N m/s or N/s", math.inf, above=True)] = None,
    integral_limit: Array = None,
    integral_min: Annotated[Array, Field("N m or N", -math.inf, low=-math.inf)] = None,
    integral_max: Annotated[Array, Field("N m or N", math.inf, low=-math.inf)] = None,
    derivative_filter_time: Annotated[Array, Field("s")] = None,
    setpoint_weight: Annotated[Array, Field("1", 1.0)] = None,
    setpoint_weight_derivative: Annotated[Array, Field("1")] = None,
    deadband: Annotated[Array, Field("rad or m")] = None,
    anti_windup: Annotated[str | Sequence[Any], Field(neutral="none")] = "none",
    tracking_time: Annotated[Array, Field("s", math.inf)] = None,
    continuous: Annotated[Array, Field(neutral=False)] = None,
    non_finite: str = "propagate",
    measurement_rate: str = "difference",
    gain_units: str = "effort",
    discretization: str = "explicit",
    joint_names: Sequence[str] | None = None,
    dtype: DType = None,
) -> PIDParams:
    """Build validated :class:`PIDParams`; a number may be a scalar, (joints,) or (envs, joints).

    ``None`` is off. A value that changes nothing anywhere (an infinite limit, a filter time of 0, a
    deadband of 0, weights b = 1 and c = 0) is off too. A gain of 0 stays: it can be tuned, and an
    integral of gain 0 can carry the bias of :func:`batchpid.track`.

    Numbers may be traced by jax.jit, jax.grad or jax.vmap. Their shapes are checked, their values
    are not, and an option that is traced is on.

    Parameters
    ----------
    joints
        Number of joints.
    kp, ki, kd
        Gains >= 0, in effort per position, per position and second, and per position/second.
    effort_limit, effort_min, effort_max
        Limits of the *total* effort [N m or N]: ``effort_limit=x`` is ``effort_min=-x,
        effort_max=x``.
    effort_rate_limit
        Largest change of the effort per second, > 0. The first step may go this far from an effort
        of 0.
    integral_limit, integral_min, integral_max
        Limits of the integral term, in effort units.
    derivative_filter_time
        Time constant of the derivative's first-order low-pass [s]; 0: unfiltered.
    setpoint_weight, setpoint_weight_derivative
        b and c: with setpoint r and measurement y, the proportional term acts on b r - y, with
        positions from the first measurement, the derivative on c r - y.
    deadband
        Half width of the dead zone: within it P and I act on an error of 0, outside on the distance
        to the zone.
    anti_windup
        "none", "clamp" (limit the integral, to the effort limits unless integral limits are given),
        "conditional" (do not integrate further into saturation) or "back_calculation"; or a nested
        list of these of shape (joints,) or (envs, joints).
    tracking_time
        Time constant of back-calculation [s]; one below the time step corrects the whole excess in
        one step. None: sqrt(kd/ki), or kp/ki without kd (K. J. Astrom and T. Hagglund, Advanced PID
        Control, 2006, sec. 3.5).
    continuous
        Bools: joints whose position is an angle modulo 2 pi [rad]; errors and differences take the
            short way round.
    non_finite
        What to do with a joint whose input is NaN or inf: "propagate" it (no check, no cost), or
        keep the state and command "zero" effort, or "hold" the last effort.
    measurement_rate
        Rate of the measurement that the derivative uses: "difference" of successive measurements,
        or "measured": the velocity that :class:`batchpid.sim.Runner` reads from the simulator. The
        pure law refuses a call without it.
    gain_units
        "effort" per position, ...; or per "mass_matrix": gains of an acceleration, which
        :class:`batchpid.sim.Runner` turns into an effort at the robot's pose
        (:mod:`batchpid.law.computed_torque`).
    discretization
        "explicit": P, I and D act on position and velocity at the beginning of the step, which is
        unstable at large gains or time steps; "implicit": on those at its end
        (:mod:`batchpid.law.implicit`), stable at any time step. It needs gain_units "mass_matrix"
        and no derivative_filter_time; without kd, kd is 0.
    joint_names
        Used in error messages.
    dtype
        float32 or float64; None: float64, or the dtype of the traced arrays.

    Raises
    ------
    InvalidArgumentError
        Naming the option, joint, env and value.
    """
    # The options of one kind are read from the tables of fields, by name; only limits and
    # anti-windup belong together.
    given = locals()
    build = LeafBuilder(joints, joint_names, dtype, given.values())
    if kp is None:
        raise InvalidArgumentError(
            "kp", "is missing", remedy="give the proportional gain, 0 for none"
        )
    p, i, d = (
        build.array(name, gain, FIELDS[name]) for name, gain in (("kp", kp), ("ki", ki), ("kd", kd))
    )
    options = {name: build.option(name, given[name], FIELDS[name]) for name in PLAIN}
    chosen = {name: build.choice(name, given[name]) for name in CHOICES}
    if chosen["discretization"] is not None:
        _check_implicit(chosen["gain_units"], options["derivative_filter_time"])
        d = build.array("kd", 0.0, FIELDS["kd"]) if d is None else d
    effort_ends = build.limits(
        effort_limit=effort_limit, effort_min=effort_min, effort_max=effort_max
    )
    integral_ends = build.limits(
        integral_limit=integral_limit, integral_min=integral_min, integral_max=integral_max
    )
    # The joints may have different strategies: each becomes an array of the joints that use it, or
    # None for none.
    clamp, conditional, back = build.strategies(anti_windup)
    integral_ends = build.clamped(clamp, integral_ends, effort_ends)
    names = "kp", "ki", "kd", "effort_min", "effort_max", "integral_min", "integral_max"
    leaves = map(build.freeze, (p, i, d, *effort_ends, *integral_ends))
    return PIDParams(
        **dict(zip(names, leaves, strict=True)),
        tracking_time=build.tracking_time(tracking_time, back, p, i, d),
        conditional=(
            Everywhere()
            if conditional is not None and conditional.all()
            else build.freeze(conditional)
        ),
        continuous=build.mask("continuous", continuous),
        **options,
        **chosen,
    )


FIELDS = declared(make_params, Field)
"""Options of a joint."""


def _is_array(leaf: Array) -> bool:
    """Return whether an entry of the params is an array, neither off nor a choice."""
    return leaf is not None and not isinstance(leaf, tuple)


def _check_implicit(gain_units: Any, filter_time: Array) -> None:
    """Raise InvalidArgumentError for options that the implicit law does not have."""
    if not isinstance(gain_units, PerMassMatrix):
        problem = "'implicit' predicts accelerations, which needs gain_units 'mass_matrix'"
        raise InvalidArgumentError(
            "discretization", problem, remedy="use these gain_units, or 'explicit'"
        )
    if filter_time is not None:
        problem = (
            "is not available with discretization 'implicit', which predicts with the unfiltered"
            " rate"
        )
        remedy = "leave it out or 0: the implicit law is stable without; or use 'explicit'"
        raise InvalidArgumentError("derivative_filter_time", problem, remedy=remedy)
