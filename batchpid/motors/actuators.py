r"""Parameters and state of actuators and sensors: build, broadcast, validate, save.

An effect that is off is ``None``: it is not a leaf and costs nothing. Every effect is declared
once, with its unit, bounds and group, as a field of :class:`Actuators`.

A file in YAML has one entry per joint, with the options of :func:`make_actuators`; a joint
that is left out has ideal actuators (:class:`batchpid.io.documents.RecordFile`)::

    format: batchpid-actuators-2
    about: {robot: arm, log: chirp.csv}
    joints:
      shoulder: {command_delay: 0.0037, strength: 0.92, coulomb: 0.4, viscous: 1.1, armature: 0.02}
      elbow: {strength: 0.95}

The efforts that a motor can deliver at a speed are its envelope. With the stall effort S, the
no-load speed v0 and the effort limit L, at the velocity v::

    high = min(max(S (1 - v / v0), -L), L)
    low  = min(max(S (-1 - v / v0), -L), L)

That is the line of a DC motor at full voltage, in all four quadrants, and the limit of its current.
It is DCMotor of Isaac Lab (isaaclab/actuators/actuator_pd.py), whose clip of the speed at v0 (1 + L
/ S) says the same, and ClampingDCMotor of Newton (newton/actuators) up to that speed, beyond which
Newton's effort goes on falling below -L.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, NamedTuple

import numpy as np

from batchpid.arrays.array_types import Array, Document, DType
from batchpid.arrays.elementwise import clip, namespace, tiny_of
from batchpid.arrays.field_tables import Field, declared, in_group
from batchpid.arrays.records import LeafBuilder, Record, with_fields
from batchpid.checks import entries, integer, is_traced
from batchpid.errors import InvalidArgumentError
from batchpid.io.documents import RecordFile

MAX_DELAY = 1.0
"""Longest delay [s]."""


class _ActuatorsFields(NamedTuple):
    command_delay: Annotated[Array, Field("s", high=MAX_DELAY, group="motor")] = None
    sensor_delay: Annotated[Array, Field("s", high=MAX_DELAY, group="sensor")] = None
    lag: Annotated[Array, Field("s", group="motor")] = None
    strength: Annotated[Array, Field("1", 1.0, group="motor")] = None
    bias: Annotated[Array, Field("N m or N", low=-math.inf, group="motor")] = None
    saturation_effort: Annotated[Array, Field("N m or N", math.inf, above=True, group="motor")] = (
        None
    )
    no_load_speed: Annotated[Array, Field("rad/s or m/s", math.inf, above=True, group="motor")] = (
        None
    )
    effort_limit: Annotated[Array, Field("N m or N", math.inf, group="motor")] = None
    coulomb: Annotated[Array, Field("N m or N", low=-math.inf, group="joint")] = None
    static: Annotated[Array, Field("N m or N", low=-math.inf, group="joint")] = None
    stribeck: Annotated[Array, Field("rad/s or m/s", group="joint")] = None
    load_friction: Annotated[Array, Field("1", high=1.0, group="joint")] = None
    viscous: Annotated[Array, Field("N m s/rad or N s/m", low=-math.inf, group="joint")] = None
    armature: Annotated[Array, Field("kg m^2 or kg", group="joint")] = None
    position_offset: Annotated[Array, Field("rad or m", low=-math.inf, group="sensor")] = None
    backlash: Annotated[Array, Field("rad or m", group="sensor")] = None
    position_resolution: Annotated[Array, Field("rad or m", group="sensor")] = None
    position_noise: Annotated[Array, Field("rad or m", group="sensor")] = None
    velocity_noise: Annotated[Array, Field("rad/s or m/s", group="sensor")] = None
    continuous: Array = None
    """1.0 on the joints whose position is an angle modulo 2 pi, 0.0 on the others."""
    max_delay: Array = None
    """Length of the histories of delayed signals (1, 1) [s]; None without delays."""
    seed: Array = None
    """Of the noise: two words (1, 2) uint32, the lower one first; None without noise."""


ACTUATOR_FIELDS = declared(_ActuatorsFields, Field)
"""Declared fields of all effects that are one number for each joint."""
MOTOR_SIDE = in_group(ACTUATOR_FIELDS, "motor")
"""Effects between the commanded and the delivered effort."""
JOINT_SIDE = in_group(ACTUATOR_FIELDS, "joint")
"""Effects on the joint instead of the signals: :class:`batchpid.sim.Runner` simulates them in the
robot's joints.
"""
DRIVEN = tuple(name for name in JOINT_SIDE if name != "load_friction")
"""Effects on joints under the engine's drives, whose effort is unknown; friction by load needs the
effort.
"""
SENSOR_SIDE = in_group(ACTUATOR_FIELDS, "sensor")
"""Effects between the joint's state and its measurement."""
DELAYS = ("command_delay", "sensor_delay")
NOISES = ("position_noise", "velocity_noise")


class Actuators(Record, _ActuatorsFields):
    """Parameters of actuators and sensors. Every leaf is a float array, (1, joints) or (envs,
    joints); None is off.

    Build it with :func:`make_actuators`, change it with :meth:`replace`: both validate. The fields
    have the meaning and the units of the options of :func:`make_actuators`.
    """

    __slots__ = ()
    NAME = "actuators"
    FIELDS = ACTUATOR_FIELDS
    WHOLE = ("max_delay", "seed")

    @property
    def measures(self) -> bool:
        """True if measurements differ from the joints' true positions or velocities."""
        return not SENSOR_SIDE.keys().isdisjoint(self.leaves())

    @property
    def delivers(self) -> bool:
        """True if the delivered efforts differ from the commanded ones."""
        return not MOTOR_SIDE.keys().isdisjoint(self.leaves())

    @property
    def is_ideal(self) -> bool:
        """True if every effect is off."""
        return ACTUATOR_FIELDS.keys().isdisjoint(self.leaves())

    def joint_side(self) -> Actuators:
        """Return the friction and reflected inertia alone, which also joints of ideal motors and
        sensors have.
        """
        return Actuators(**{name: getattr(self, name) for name in JOINT_SIDE})

    def options(self) -> Document:
        """Return the effects that are on, as arguments of :func:`make_actuators` that build these
        actuators again.
        """
        options = self.leaves()
        if self.continuous is not None:
            options["continuous"] = self.continuous > 0
        if self.seed is not None:
            options["seed"] = int(self.seed[0, 0]) + (int(self.seed[0, 1]) << 32)
        options.pop("max_delay", None)
        if options:
            options["dtype"] = self.dtype
        return options

    def replace(self, **options: object) -> Actuators:
        """Return actuators with some options of :func:`make_actuators` changed, checked as there."""
        present = self.options()
        # Traced numbers have a dtype.
        if any(is_traced(value) for value in options.values()):
            present.pop("dtype", None)
        if not self.num_joints and "joints" not in options:
            remedy = "build them with make_actuators(), or give joints="
            raise InvalidArgumentError(
                "joints", "is missing, and every effect is off", remedy=remedy
            )
        return make_actuators(**{"joints": self.num_joints, **present, **options})


@with_fields(*ACTUATOR_FIELDS)
def make_actuators(
    joints: int,
    *,
    seed: int = 0,
    continuous: Array = None,
    joint_names: Sequence[str] | None = None,
    dtype: DType = None,
    **effects: Array,
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
        interpolated. Histories are as long as the largest delay of all envs, 1 s where a delay is
        traced by JAX.
    lag
        Time constant T >= 0 of the effort's first-order lag [s].
    strength
        Factor >= 0 of the effort, 1 for a motor as the controller believes it to be.
    bias
        Effort added by the motor [N m or N].
    saturation_effort, no_load_speed
        Effort at stall, > 0 [N m or N], and speed without load, > 0 [rad/s or m/s], of the line
        between them: the torque-speed envelope (:mod:`batchpid.motors.actuators`). Given together.
    effort_limit
        Largest effort that the motor delivers, >= 0 [N m or N].
    coulomb, viscous
        Friction of the joint [N m or N; N m s/rad or N s/m], in addition to the description's, by
        the model of :mod:`batchpid.motors.friction`. Negative where the description's is too large;
        a robot refuses sums below 0.
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
    position_resolution
        Step >= 0 of measured positions [rad or m].
    position_noise, velocity_noise
        Standard deviation >= 0 of the Gaussian noise of each sample [rad or m, and per second].
    seed
        Seed of the noise, from 0 to 2^64 - 1.
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
    build = LeafBuilder(joints, joint_names, dtype, effects.values())
    leaves = build.options(ACTUATOR_FIELDS, effects)
    # Friction at rest counts only where it is more than in motion; without it no speed ends it.
    if leaves["static"] is None and effects.get("static") is not None:
        leaves["stribeck"] = None
    _check_together(leaves, build.names)
    longest = _longest_delay(leaves)
    words = integer("seed", seed, 0, 2**64 - 1)
    has_noise = any(leaves[name] is not None for name in NOISES)
    return Actuators(
        **leaves,
        continuous=build.mask("continuous", continuous),
        max_delay=None if longest is None else build.freeze(np.array([[longest]])),
        seed=np.array([[words & 0xFFFFFFFF, words >> 32]], np.uint32) if has_noise else None,
    )


def _check_together(leaves: Document, joint_names: Sequence[str] | None) -> None:
    """Raise InvalidArgumentError for effects that lack another one, or contradict it."""
    # One end does not make a line.
    missing = [name for name in ("saturation_effort", "no_load_speed") if leaves[name] is None]
    if len(missing) == 1:
        remedy = "give both ends of the torque-speed line, or none"
        raise InvalidArgumentError(missing[0], "is missing", remedy=remedy)
    static = leaves["static"]
    coulomb = leaves["coulomb"]
    if static is None:
        if leaves["stribeck"] is not None:
            remedy = "give static, or leave it out"
            raise InvalidArgumentError("stribeck", "has no effect without static", remedy=remedy)
    elif not is_traced(static) and not is_traced(coulomb):
        good = (static == 0) | (static >= (0.0 if coulomb is None else coulomb))
        remedy = "give at least coulomb, or 0"
        entries(
            "static",
            static,
            good,
            "is less than coulomb",
            joint_names,
            remedy=remedy,
        )


def _longest_delay(leaves: Document) -> float | None:
    """Return the length of the histories [s]; None without delays."""
    delays = [leaves[name] for name in DELAYS if leaves[name] is not None]
    # A traced delay is not known; its history is as long as any delay may be.
    return max(
        (MAX_DELAY if is_traced(rows) else float(rows.max()) for rows in delays), default=None
    )


class _ActuatorStateFields(NamedTuple):
    command: Array = None
    """Commanded efforts, latest first (envs, samples, joints) [N m or N]."""
    effort: Array = None
    """Effort behind the lag (envs, joints) [N m or N]."""
    position: Array = None
    """Positions at the sensor, latest first (envs, samples, joints) [rad or m]."""
    velocity: Array = None
    """Velocities there, latest first (envs, samples, joints) [rad/s or m/s]."""
    encoder: Array = None
    """Position of the sensor's side of the play (envs, joints) [rad or m]."""
    key: Array = None
    """Key of the noise, a hash of seed, env and episode (envs, 2) uint32."""
    step: Array = None
    """Measurements since the reset (envs,) uint32."""


class ActuatorState(Record, _ActuatorStateFields):
    """State of actuators and sensors; None where no effect needs it. Every array has the envs as
    its first axis.
    """

    __slots__ = ()
    NAME = "state"


ACTUATORS = RecordFile(
    "batchpid-actuators-2",
    Actuators,
    make_actuators,
    ("dtype", "seed"),
    {**ACTUATOR_FIELDS, "continuous": Field(neutral=False)},
    partial=True,
)
dumps_actuators = ACTUATORS.dumps
loads_actuators = ACTUATORS.loads
save_actuators = ACTUATORS.save
load_actuators = ACTUATORS.load


class Envelope(NamedTuple):
    """Envelope in the symbols above; None is off."""

    stall: Array = None
    """S."""
    reverse: Array = None
    """-S."""
    slope: Array = None
    """S / v0."""
    limit: Array = None
    """L."""
    least: Array = None
    """-L."""


def envelope(actuators: Actuators) -> Envelope:
    """Return the envelope of the efforts that the motors of ``actuators`` deliver."""
    xp = namespace(*actuators)
    stall = actuators.saturation_effort
    limit = actuators.effort_limit
    k = Envelope(limit=limit, least=None if limit is None else -limit)
    if stall is None:
        return k
    # A motor without a stall effort has no line, so its slope is 0.
    finite = xp.isfinite(stall)
    slope = xp.where(finite, xp.where(finite, stall, 0.0) / actuators.no_load_speed, 0.0)
    return k._replace(
        stall=stall,
        reverse=-stall,
        slope=slope,
    )


def command_envelope(actuators: Actuators) -> Envelope:
    """Return the envelope of the commands u of motors that deliver s u + b: each bound e of the
    efforts becomes (e - b) / s.

    Where s = 0 it is wide: no command matters.
    """
    k = envelope(actuators)
    strength = actuators.strength
    if strength is None and actuators.bias is None:
        return k
    divisor: Array = 1.0
    if strength is not None:
        divisor = namespace(strength).maximum(strength, tiny_of(strength.dtype))
    shift = 0.0 if actuators.bias is None else actuators.bias

    def command(end: Array) -> Array:
        if end is None:
            return None
        return (end - shift) / divisor

    slope = None if k.slope is None else k.slope / divisor
    return Envelope(
        stall=command(k.stall),
        reverse=command(k.reverse),
        slope=slope,
        limit=command(k.limit),
        least=command(k.least),
    )


def limits(k: Envelope, velocity: Array) -> tuple[Array, Array]:
    """Return the least and the largest effort, or command, at ``velocity`` (envs, joints), None for
    none.

    Both are None, or none is.
    """
    if k.stall is None:
        return k.least, k.limit
    xp = namespace(velocity)
    lost = k.slope * velocity
    return clip(k.reverse - lost, k.least, k.limit, xp), clip(k.stall - lost, k.least, k.limit, xp)
