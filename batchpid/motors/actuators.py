"""Parameters of actuators and sensors: build, broadcast, validate.

:class:`Actuators` is a ``NamedTuple`` of float arrays, hence a pytree that JAX knows without
registration. An effect that is off is ``None``: it is not a leaf and costs nothing.

Every effect is declared once, by an argument of :func:`make_actuators` with its unit, bounds and
group.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Any, NamedTuple

import numpy as np

from batchpid.arrays.array_types import Array, Document, DType
from batchpid.arrays.display import span, summary
from batchpid.arrays.field_tables import WHOLE, Field, check_leaves, declared, in_group
from batchpid.arrays.leaves import LeafBuilder
from batchpid.checks.validate import entries, integer, is_traced, known_keywords, number, read_array
from batchpid.errors import InvalidArgumentError

MAX_DELAY = 1.0
"""Longest delay [s]."""
TABLE = {"limit_efforts": Field("N m or N", math.inf)}
"""Declared field of the efforts at the points of a position-dependent limit."""


class Actuators(NamedTuple):
    """Parameters of actuators and sensors. Every leaf is a float array, (1, joints) or (envs,
    joints); None is off.

    Build it with :func:`make_actuators`, change it with :meth:`replace`: both validate. The fields
    have the meaning and the units of the options of :func:`make_actuators`.
    """

    command_delay: Array = None
    sensor_delay: Array = None
    lag: Array = None
    strength: Array = None
    bias: Array = None
    saturation_effort: Array = None
    no_load_speed: Array = None
    effort_limit: Array = None
    limit_positions: Array = None
    """x_k of the limit that depends on the position (1, joints, points)."""
    limit_efforts: Array = None
    """L_k (1, joints, points)."""
    coulomb: Array = None
    static: Array = None
    stribeck: Array = None
    load_friction: Array = None
    viscous: Array = None
    armature: Array = None
    position_offset: Array = None
    backlash: Array = None
    position_resolution: Array = None
    velocity_resolution: Array = None
    position_noise: Array = None
    velocity_noise: Array = None
    continuous: Array = None
    """1.0 on the joints whose position is an angle modulo 2 pi, 0.0 on the others."""
    max_delay: Array = None
    """Length of the histories of delayed signals (1, 1) [s]; None without delays."""
    seed: Any = None
    """Of the noise: two words (1, 2) uint32, the lower one first; None without noise."""

    @property
    def num_joints(self) -> int | None:
        """Number of joints; None where every effect is off."""
        return next((int(leaf.shape[1]) for leaf in self[:-2] if leaf is not None), None)

    @property
    def num_envs(self) -> int:
        """Number of envs with separate actuators; 1 where all envs share them."""
        return max((leaf.shape[0] for leaf in self if leaf is not None), default=1)

    @property
    def measures(self) -> bool:
        """True if measurements differ from the joints' true positions or velocities."""
        return any(getattr(self, name) is not None for name in SENSOR_SIDE)

    @property
    def delivers(self) -> bool:
        """True if the efforts delivered differ from those asked for."""
        return any(getattr(self, name) is not None for name in (*MOTOR_SIDE, *TABLE))

    @property
    def is_ideal(self) -> bool:
        """True if every effect is off."""
        return not (self.measures or self.delivers) and all(
            leaf is None for leaf in self.joint_side()
        )

    def for_envs(self, envs: slice | Any) -> Actuators:
        """Return the actuators of some envs (a slice or an index array); shared rows stay
        shared.
        """
        return Actuators(
            *(leaf if leaf is None or leaf.shape[0] == 1 else leaf[envs] for leaf in self)
        )

    def for_joints(self, joints: Any) -> Actuators:
        """Return the actuators of some joints (an index array or a mask)."""
        leaves = self._asdict().items()
        return Actuators(
            **{
                name: leaf if leaf is None or name in WHOLE else leaf[:, joints]
                for name, leaf in leaves
            }
        )

    def joint_side(self) -> Actuators:
        """Return the friction and reflected inertia alone, which also joints of ideal motors and
        sensors have.
        """
        return Actuators(**{name: getattr(self, name) for name in JOINT_SIDE})

    def options(self) -> Document:
        """Return the effects that are on, as arguments of :func:`make_actuators` that build these
        actuators again.
        """
        options = {name: leaf for name, leaf in self._asdict().items() if leaf is not None}
        if self.continuous is not None:
            options["continuous"] = self.continuous > 0
        if self.limit_positions is not None:
            options["position_limit"] = options.pop("limit_positions"), options.pop("limit_efforts")
        if self.seed is not None:
            options["seed"] = int(self.seed[0, 0]) + (int(self.seed[0, 1]) << 32)
        if self.max_delay is not None and not is_traced(self.max_delay):
            options["max_delay"] = float(self.max_delay[0, 0])
        if options:
            options["dtype"] = next(leaf.dtype for leaf in self if leaf is not None)
        return options

    def replace(self, **options: Any) -> Actuators:
        """Return actuators with some options of :func:`make_actuators` changed, checked as there.

        With other delays max_delay is theirs, unless it is given too.
        """
        known = self.options()
        if not options.keys().isdisjoint(("command_delay", "sensor_delay")):
            known.pop("max_delay", None)
        if any(is_traced(value) for value in options.values()):
            known.pop("dtype", None)
        if self.num_joints is None and "joints" not in options:
            remedy = "build them with make_actuators(), or give joints="
            raise InvalidArgumentError("joints", "is not known: every effect is off", remedy=remedy)
        return make_actuators(**{"joints": self.num_joints, **known, **options})

    def __repr__(self) -> str:
        on = {
            name: leaf
            for name, leaf in self._asdict().items()
            if leaf is not None and name != "seed"
        }
        sizes = [f"{self.num_envs} envs"] * (self.num_envs > 1) + [
            f"{self.num_joints} joints"
        ] * bool(on)
        return summary(
            "Actuators",
            [*sizes, *(f"{name.replace('_', ' ')} {span(leaf)}" for name, leaf in on.items())],
        )


@known_keywords
def make_actuators(
    joints: int,
    *,
    command_delay: Annotated[Array, Field("s", high=MAX_DELAY, group="motor")] = None,
    lag: Annotated[Array, Field("s", group="motor")] = None,
    strength: Annotated[Array, Field("1", 1.0, group="motor")] = None,
    bias: Annotated[Array, Field("N m or N", low=-math.inf, group="motor")] = None,
    saturation_effort: Annotated[
        Array, Field("N m or N", math.inf, above=True, group="motor")
    ] = None,
    no_load_speed: Annotated[
        Array, Field("rad/s or m/s", math.inf, above=True, group="motor")
    ] = None,
    effort_limit: Annotated[Array, Field("N m or N", math.inf, group="motor")] = None,
    position_limit: tuple[Array, Array] | None = None,
    coulomb: Annotated[Array, Field("N m or N", group="joint")] = None,
    static: Annotated[Array, Field("N m or N", group="joint")] = None,
    stribeck: Annotated[Array, Field("rad/s or m/s", group="joint")] = None,
    load_friction: Annotated[Array, Field("1", high=1.0, group="joint")] = None,
    viscous: Annotated[Array, Field("N m s/rad or N s/m", group="joint")] = None,
    armature: Annotated[Array, Field("kg m^2 or kg", group="joint")] = None,
    sensor_delay: Annotated[Array, Field("s", high=MAX_DELAY, group="sensor")] = None,
    position_offset: Annotated[Array, Field("rad or m", low=-math.inf, group="sensor")] = None,
    backlash: Annotated[Array, Field("rad or m", group="sensor")] = None,
    position_resolution: Annotated[Array, Field("rad or m", group="sensor")] = None,
    velocity_resolution: Annotated[Array, Field("rad/s or m/s", group="sensor")] = None,
    position_noise: Annotated[Array, Field("rad or m", group="sensor")] = None,
    velocity_noise: Annotated[Array, Field("rad/s or m/s", group="sensor")] = None,
    seed: int = 0,
    max_delay: float | None = None,
    continuous: Array = None,
    joint_names: Sequence[str] | None = None,
    dtype: DType = None,
) -> Actuators:
    """Build validated :class:`Actuators`; a number may be a scalar, (joints,) or (envs, joints).

    ``None`` is off, and so is a value that changes nothing anywhere. Numbers may be traced by JAX;
    their shapes are checked, their values are not.

    Parameters
    ----------
    joints
        Number of joints.
    command_delay, sensor_delay
        Age of the command that the motor follows, and of the position and velocity that the
        controller sees, from 0 to 1 [s]. Any real number: values between two samples are
        interpolated.
    lag
        Time constant T >= 0 of the effort's first-order lag [s].
    strength
        Factor >= 0 of the effort, 1 for a motor as the controller believes it to be.
    bias
        Effort added by the motor [N m or N].
    saturation_effort, no_load_speed
        Effort at stall, > 0 [N m or N], and speed without load, > 0 [rad/s or m/s], of the line
        between them: the torque-speed envelope (:mod:`batchpid.motors.envelope`). Given together.
    effort_limit
        Largest effort that the motor delivers, >= 0 [N m or N].
    position_limit
        Limit that depends on the position: positions [rad or m], ascending, and efforts >= 0 there
        [N m or N], both (points,), (joints, points) or (envs, joints, points). Linear between the
        points, constant outside.
    coulomb, viscous
        Friction >= 0 of the joint [N m or N; N m s/rad or N s/m], in addition to the description's,
        by the model of :mod:`batchpid.motors.friction`.
    static
        Friction that holds the joint at rest, where that is more than while it moves [N m or N]: >=
        ``coulomb``, also in addition to the description's. 0: as much as while it moves.
    stribeck
        Speed >= 0 at which the friction of a joint that slides has fallen half way from ``static``
        to ``coulomb`` [rad/s or m/s]. 0: it has fallen as soon as the joint slides.
    load_friction
        Friction that grows with the load, as in gears: from 0 to 1, over the motor's effort.
    armature
        Reflected inertia of the motor >= 0 [kg m^2 or kg].
    position_offset
        Error of the encoder's zero, added to measured positions [rad or m].
    backlash
        Play >= 0 between the joint and its sensor, from one end to the other [rad or m].
    position_resolution, velocity_resolution
        Step >= 0 of measured positions [rad or m] and velocities [rad/s or m/s].
    position_noise, velocity_noise
        Standard deviation >= 0 of the Gaussian noise of each sample [rad or m, and per second].
    seed
        Seed of the noise, from 0 to 2^64 - 1.
    max_delay
        Length of the histories that delayed signals have [s]; None: the largest delay of all envs.
        A longer one is needed where delays are to grow in flight: a delay beyond the history
        returns its oldest sample.
    continuous
        Bools: joints whose position is an angle modulo 2 pi [rad].
    joint_names
        Used in error messages.
    dtype
        float32 or float64; None: float64, or the dtype of the traced arrays.

    Raises
    ------
    InvalidArgumentError
        Naming the option, joint, env and value.
    """
    given = locals()
    build = LeafBuilder(joints, joint_names, dtype, given.values())
    leaves: Document = {
        name: build.option(name, given[name], field) for name, field in FIELDS.items()
    }
    longest = (
        MAX_DELAY
        if max_delay is None
        else number("max_delay", max_delay, 0.0, MAX_DELAY, "seconds")
    )
    delays = [
        (name, delay)
        for name in ("command_delay", "sensor_delay")
        if (delay := leaves[name]) is not None
    ]
    for name, delay in delays:
        if not is_traced(delay) and (delay > longest).any():
            remedy = f"use a number from 0 to {longest:g} (seconds)"
            raise InvalidArgumentError(
                name, "out of range", value=float(delay.max()), remedy=remedy
            )
    if max_delay is None and not any(is_traced(delay) for _, delay in delays):
        longest = max((float(delay.max()) for _, delay in delays), default=0.0)
    if (leaves["saturation_effort"] is None) != (leaves["no_load_speed"] is None):
        missing = "no_load_speed" if leaves["no_load_speed"] is None else "saturation_effort"
        raise InvalidArgumentError(
            missing, "is missing", remedy="give both ends of the torque-speed line, or none"
        )
    if (static := leaves["static"]) is not None and not is_traced(static):
        coulomb = 0.0 if leaves["coulomb"] is None else leaves["coulomb"]
        good = is_traced(coulomb) or (static >= coulomb) | (static == 0)
        entries(
            "static",
            static,
            good,
            "is less than coulomb",
            joint_names,
            remedy="give at least coulomb, or 0",
        )
    if leaves["stribeck"] is not None and static is None:
        if given["static"] is None:
            raise InvalidArgumentError(
                "stribeck", "has no effect without static", remedy="give static, or leave it out"
            )
        leaves["stribeck"] = None
    points, efforts = _table(build, position_limit)
    noisy = leaves["position_noise"] is not None or leaves["velocity_noise"] is not None
    words = integer("seed", seed, 0, 2**64 - 1)
    return Actuators(
        **leaves,
        limit_positions=points,
        limit_efforts=efforts,
        continuous=build.mask("continuous", continuous),
        max_delay=build.freeze(np.array([[longest]])) if delays else None,
        seed=np.array([[words & 0xFFFFFFFF, words >> 32]], np.uint32) if noisy else None,
    )


FIELDS = declared(make_actuators, Field)
"""Declared fields of all effects that are one number for each joint."""
MOTOR_SIDE = in_group(FIELDS, "motor")
"""Effects between the effort asked for and the effort delivered."""
JOINT_SIDE = in_group(FIELDS, "joint")
"""Effects on the joint instead of the signals: :class:`batchpid.sim.Runner` simulates them in the
robot's joints.
"""
DRIVEN = tuple(name for name in JOINT_SIDE if name != "load_friction")
"""Effects on joints under the engine's drives, whose effort is unknown; friction by load needs the
effort.
"""
SENSOR_SIDE = in_group(FIELDS, "sensor")
"""Effects between the joint's state and its measurement."""


def _table(build: LeafBuilder, table: tuple[Any, Any] | None) -> tuple[Array, Array]:
    """Return the positions and efforts of a limit that depends on the position (1 | envs, joints,
    points).
    """
    if table is None:
        return None, None
    remedy = (
        "give positions and efforts (points,), (joints, points) or (envs, joints, points), with two"
        " points or more"
    )
    if not isinstance(table, tuple | list | np.ndarray) or len(table) != 2:
        raise InvalidArgumentError("position_limit", "must be a pair", value=table, remedy=remedy)
    rows = [read_array("position_limit", each).astype(build.dtype) for each in table]
    for each in rows:
        if (
            each.ndim not in (1, 2, 3)
            or each.shape[-1] < 2
            or (each.ndim > 1 and each.shape[-2] != build.joints)
        ):
            raise InvalidArgumentError("position_limit", f"has shape {each.shape}", remedy=remedy)
    if rows[0].shape[-1] != rows[1].shape[-1]:
        problem = f"has {rows[0].shape[-1]} positions and {rows[1].shape[-1]} efforts"
        raise InvalidArgumentError("position_limit", problem, remedy=remedy)
    shape = (1, build.joints, rows[0].shape[-1])
    positions, efforts = (
        np.broadcast_to(each, np.broadcast_shapes(each.shape, shape)) for each in rows
    )
    rising = np.isfinite(positions)
    rising[..., 1:] &= positions[..., 1:] >= positions[..., :-1]
    good = (efforts >= 0) & (np.isfinite(efforts) | np.isinf(efforts).all(2, keepdims=True))
    problems = "has positions that do not ascend", "has an effort < 0 or not finite"
    for each, right, problem in zip((positions, efforts), (rising, good), problems, strict=True):
        first = np.take_along_axis(each, right.argmin(2, keepdims=True), 2)[..., 0]
        entries("position_limit", first, right.all(2), problem, build.names)
    return (
        (None, None)
        if np.isinf(efforts).all()
        else (build.freeze(positions), build.freeze(efforts))
    )


def check_actuators(actuators: Actuators, num_envs: int, joint_names: Sequence[str]) -> None:
    """Raise InvalidArgumentError unless every leaf is right for (num_envs, joints): for edits by
    hand.
    """
    check_leaves("actuators", actuators, FIELDS | TABLE, num_envs, joint_names)
