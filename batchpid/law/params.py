"""The parameters of the control law: build, broadcast, validate.

An option that is off is ``None``, which is not a leaf: NumPy skips it and ``jax.jit`` compiles a
law without it. Choices without a number, such as the unit of the gains, are tuples without fields
(:mod:`batchpid.arrays.array_types`): part of the tree's structure, and so static under every JAX
transform.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, NamedTuple

import numpy as np

from batchpid.arrays.array_types import (
    CHOICES,
    Array,
    BackCalculation,
    Clamp,
    Document,
    DType,
    NamedChoice,
    PerMassMatrix,
)
from batchpid.arrays.elementwise import namespace
from batchpid.arrays.field_tables import Field, declared
from batchpid.arrays.records import LeafBuilder, Record, with_fields
from batchpid.checks import choice, is_traced
from batchpid.errors import InvalidArgumentError

DEFAULTS = {name: next(iter(chosen)) for name, chosen in CHOICES.items()}
"""Default of each choice."""
GAINS = ("kp", "ki", "kd")
ENDS = ("effort_min", "effort_max", "integral_min", "integral_max")
PLAIN = (
    "effort_rate_limit",
    "derivative_filter_time",
    "setpoint_weight",
    "setpoint_weight_derivative",
    "deadband",
)
"""Options whose leaf depends on no other option."""


class _ParamsFields(NamedTuple):
    kp: Annotated[Array, Field("N m/rad or N/m")]
    ki: Annotated[Array, Field("N m/(rad s) or N/(m s)")] = None
    kd: Annotated[Array, Field("N m s/rad or N s/m")] = None
    effort_min: Annotated[Array, Field("N m or N", -math.inf, low=-math.inf)] = None
    effort_max: Annotated[Array, Field("N m or N", math.inf, low=-math.inf)] = None
    effort_rate_limit: Annotated[Array, Field("N m/s or N/s", math.inf, above=True)] = None
    integral_min: Annotated[Array, Field("N m or N", -math.inf, low=-math.inf)] = None
    integral_max: Annotated[Array, Field("N m or N", math.inf, low=-math.inf)] = None
    derivative_filter_time: Annotated[Array, Field("s")] = None
    setpoint_weight: Annotated[Array, Field("1", 1.0)] = None
    setpoint_weight_derivative: Annotated[Array, Field("1")] = None
    deadband: Annotated[Array, Field("rad or m")] = None
    tracking_time: Annotated[Array, Field("s", math.inf)] = None
    """inf: the integral of that joint does not track."""
    continuous: Annotated[Array, Field(neutral=False)] = None
    """1.0 on the joints whose position is an angle modulo 2 pi, 0.0 on the others."""
    anti_windup: NamedChoice | None = None
    """Clamp(), Conditional() or BackCalculation()."""
    measurement_rate: NamedChoice | None = None
    """MeasuredRate(): the caller passes the measured rate; off: the law takes differences of
    measurements.
    """
    gain_units: NamedChoice | None = None
    """PerMassMatrix(): the law returns accelerations, which the caller converts to efforts; off:
    efforts.
    """
    discretization: NamedChoice | None = None
    """ImplicitLaw(): the law acts on the predicted end of the step; off: on its beginning."""


LAW_FIELDS = declared(_ParamsFields, Field)
"""Options of a joint."""


class PIDParams(Record, _ParamsFields):
    """Parameters of the law. Every leaf is a float array, (1, joints) or (envs, joints); None is
    off.

    Build it with :func:`make_params`, change it with :meth:`replace`: both validate, and both take
    traced gains. The fields have the meaning and the units of the options of :func:`make_params`;
    those with another form say so.
    """

    __slots__ = ()
    NAME = "params"
    FIELDS = LAW_FIELDS

    def options(self) -> Document:
        """Return the options that are on, as arguments of :func:`make_params` that build these
        params again.
        """
        options: Document = {}
        for name, leaf in self.leaves().items():
            if name in LAW_FIELDS:
                options[name] = leaf if is_traced(leaf) else np.array(leaf)
        for name, chosen in CHOICES.items():
            kind = type(getattr(self, name))
            (options[name],) = (text for text, entry in chosen.items() if type(entry) is kind)
        if self.continuous is not None:
            options["continuous"] = options["continuous"] > 0
        return {**options, "dtype": np.dtype(self.dtype)}

    def replace(self, **options: object) -> PIDParams:
        """Return params with some options of :func:`make_params` changed, checked as there."""
        present = self.options()
        # A limit that is given replaces both ends that stand.
        for end in ("effort", "integral"):
            if f"{end}_limit" in options:
                present.pop(f"{end}_min", None)
                present.pop(f"{end}_max", None)
        if any(is_traced(value) for value in options.values()):
            del present["dtype"]
        # The time constant belongs to the strategy that stands.
        if "anti_windup" in options:
            present.pop("tracking_time", None)
        return make_params(self.num_joints, **present | options)


@with_fields(*LAW_FIELDS, *DEFAULTS)
def make_params(
    joints: int,
    kp: Array,
    ki: Array = None,
    kd: Array = None,
    *,
    effort_limit: Array = None,
    integral_limit: Array = None,
    joint_names: Sequence[str] | None = None,
    dtype: DType = None,
    **options: Array,
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
        "conditional" (do not integrate further into saturation) or "back_calculation".
    tracking_time
        Time constant of back-calculation [s]; one below the time step corrects the whole excess in
        one step, inf none of it. None: sqrt(kd/ki), or kp/ki without kd (K. J. Astrom and T. Hagglund, Advanced PID
        Control, 2006, sec. 3.5).
    continuous
        Bools: joints whose position is an angle modulo 2 pi [rad]; errors and differences take the
            short way round.
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
        (:mod:`batchpid.law.coefficients`), stable at any time step. It needs gain_units
        "mass_matrix" and no derivative_filter_time; without kd, kd is 0.
    joint_names
        Used in error messages.
    dtype
        float32 or float64; None: float64, or the dtype of the traced arrays.

    Raises
    ------
    InvalidArgumentError
        Naming the option, joint, env and value.
    """
    # The dtype may come from any option that is traced, so all are looked at.
    options |= {"kp": kp, "ki": ki, "kd": kd}
    options |= {"effort_limit": effort_limit, "integral_limit": integral_limit}
    build = LeafBuilder(joints, joint_names, dtype, options.values())
    # kp may be traced, so a missing one is None and not 0.
    if kp is None:
        remedy = "give the proportional gain, 0 for none"
        raise InvalidArgumentError("kp", "is missing", remedy=remedy)
    leaves: Document = {name: build.array(name, options[name], LAW_FIELDS[name]) for name in GAINS}
    leaves |= build.options({name: LAW_FIELDS[name] for name in PLAIN}, options)
    for name, chosen in CHOICES.items():
        leaves[name] = chosen[choice(name, options.get(name, DEFAULTS[name]), chosen)]
    # The implicit law predicts with kd, so it needs one, 0 as well.
    if leaves["discretization"] is not None:
        _check_implicit(leaves["gain_units"], leaves["derivative_filter_time"])
        if kd is None:
            leaves["kd"] = build.array("kd", 0.0, LAW_FIELDS["kd"])
    effort = build.limits("effort_limit", "effort_min", "effort_max", options)
    integral = build.limits("integral_limit", "integral_min", "integral_max", options)
    if isinstance(leaves["anti_windup"], Clamp) and all(end is None for end in integral):
        if all(end is None for end in effort):
            problem = "'clamp' has no limit to clamp the integral to"
            remedy = "give integral_limit or effort_limit"
            raise InvalidArgumentError("anti_windup", problem, remedy=remedy)
        integral = effort
    leaves |= dict(zip(ENDS, (*effort, *integral), strict=True))
    leaves["tracking_time"] = _tracking_time(build, options.get("tracking_time"), leaves)
    leaves["continuous"] = build.mask("continuous", options.get("continuous"))
    # A choice is not an array.
    for name in LAW_FIELDS:
        leaves[name] = build.freeze(leaves[name])
    return PIDParams(**leaves)


def _check_implicit(gain_units: NamedChoice | None, filter_time: Array) -> None:
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


def _tracking_time(build: LeafBuilder, value: Array, leaves: Document) -> Array:
    """Return the time constant of back-calculation, None without it."""
    if isinstance(leaves["anti_windup"], BackCalculation):
        time = build.array("tracking_time", value, LAW_FIELDS["tracking_time"])
        return _rule_of_thumb(*[leaves[name] for name in GAINS]) if time is None else time
    if value is not None:
        problem = "is given, but anti_windup is not 'back_calculation'"
        remedy = "choose that strategy or leave tracking_time out"
        raise InvalidArgumentError("tracking_time", problem, remedy=remedy)
    return None


def _rule_of_thumb(kp: Array, ki: Array, kd: Array) -> Array:
    """Return Tt = sqrt(Ti Td) = sqrt(kd/ki), or Ti = kp/ki without kd; inf, no correction, where ki
    is 0.
    """
    xp = namespace(kp, ki, kd)
    if ki is None:
        return xp.full_like(kp, math.inf)
    kp, ki, kd = xp.broadcast_arrays(kp, ki, xp.zeros_like(kp) if kd is None else kd)
    # Where ki is 0 the quotient is not used, but must be finite.
    safe = xp.where(ki > 0, ki, 1.0)
    # The inner where keeps the gradient of the square root finite where kd is 0.
    times = xp.where(
        kd > 0,
        xp.sqrt(xp.where(kd > 0, kd, 1.0) / safe),
        kp / safe,
    )
    return xp.where(ki > 0, times, math.inf)
