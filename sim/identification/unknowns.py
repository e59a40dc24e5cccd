"""Unknowns of a fit: a table of their kinds, their names, scales, bounds and weak priors, and the motors at a point."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Float64
from batchpid.motors.actuators import FIELDS, Actuators

Motors = dict[str, Float64]
"""Values of n candidates by kind of unknown: (n, joints), or (n, 1) for a value that all joints share."""


class Kind(NamedTuple):
    """Kind of unknown, in SI units."""

    field: str | None
    """Field of :class:`batchpid.Actuators`; None: of the plant, :mod:`batchpid.sim.identification.plant`, or of the
    law, :meth:`batchpid.sim.identification.logged_control.LoggedDrive.of`."""
    per_joint: bool
    low: float
    high: float
    size: str | float
    """Typical size: a number, or the name of a typical value of each joint, see :meth:`Unknowns.of`."""
    spread: float
    """Standard deviation of the prior, over the typical size."""
    start: float = 0.0
    """Mean of the prior, and value at the start of a fit where the regression does not give it."""
    off: float = 0.0
    """Value without effect, for kinds without field."""
    tries: tuple[float, ...] = ()
    """Values to try first, over the typical size, for kinds that are added to a fit."""

    @property
    def neutral(self) -> float:
        """Value of ideal motors."""
        return self.off if self.field is None else FIELDS[self.field].neutral


KINDS = {
    "armature": Kind("armature", True, 0.0, np.inf, "inertia", 10.0),
    "damping": Kind("viscous", True, 0.0, np.inf, "damping", 10.0),
    "friction": Kind("coulomb", True, 0.0, np.inf, "effort", 10.0),
    "strength": Kind("strength", True, 0.05, 5.0, 1.0, 0.5, 1.0),
    "bias": Kind("bias", True, -np.inf, np.inf, "effort", 10.0),
    "delay": Kind("command_delay", False, 0.0, 0.09, 5e-3, 20.0),
    "stopping": Kind(None, False, 5e-4, 0.1, 5e-3, 4.0, 5e-3),
    "payload": Kind(None, False, 0.0, np.inf, 0.2, 50.0),
}
"""Kinds of unknowns that every fit has. An effect of the motor or the sensor needs one line, here, or in :data:`ADDED`
and :data:`EXTRAS`; one that acts on the joint is a term of :mod:`batchpid.sim.identification.plant` as well."""
ADDED = {
    "lag": Kind("lag", True, 0.0, 0.1, 5e-3, 20.0),
    "load_friction": Kind("load_friction", True, 0.0, 0.9, 0.1, 5.0, tries=(0.5, 2.0)),
    "static": Kind("static", True, 0.0, np.inf, "friction", 10.0, tries=(1.3, 2.0)),
    "stribeck": Kind("stribeck", True, 0.0, np.inf, "speed", 2.0, tries=(0.03, 0.2)),
    "offset": Kind("position_offset", True, -np.inf, np.inf, 0.01, 20.0, tries=(0.0,)),
    "gain": Kind(None, True, 1e-3, 1e3, 1.0, 100.0, 1.0, off=1.0),
    "kd": Kind(None, True, 0.0, 1e3, 1.0, 10.0, 1.0, off=1.0, tries=(0.5, 2.0)),
    "saturation": Kind(
        None, True, 1e-4, np.inf, "error", 10.0, off=np.inf, tries=(0.1, 0.15, 0.2, 0.3, 0.45, 0.65, 0.9)
    ),
    "slew": Kind(None, True, 1e-3, np.inf, "speed", 10.0, off=np.inf, tries=(0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.2)),
}
"""Kinds that a fit has on request only. Otherwise simulations leave them out.

"gain" is a factor of all gains of the law, "kd" of kd alone; "saturation" is the law's effort limit over its
kp [rad or m], and "slew" the limit of its setpoints' rate [rad/s or m/s].
"""
LAW = ("gain", "kd", "saturation", "slew")
"""Kinds of the law."""
EXTRAS = {
    "load_friction": ("load_friction",),
    "stribeck": ("static", "stribeck"),
    "offset": ("offset",),
    "kd": ("kd",),
    "saturation": ("saturation",),
    "slew": ("slew",),
}
"""Kinds that are added to a fit together, and kept at joints where they lower the error on the held-out part."""
DESCRIBED = {"damping": "damping", "friction": "friction", "static": "friction"}
"""Kinds to which the robot's description contributes, and the name there. Values of a fit include that part."""
SCALES, SCALED = ("strength", "gain"), ("armature", "damping", "friction", "static", "bias")
"""Kinds that scale a joint's efforts, and kinds that must be scaled with them to keep its motion unchanged."""
_STEP = 2e-3
"""Change of an unknown for a finite difference, in units of its scale."""
_STRENGTH_STEP = 1e-2
"""Relative change of a strength for a finite difference."""


def kind_of(name: str) -> Kind:
    """Return the kind of a name."""
    return KINDS[name] if name in KINDS else ADDED[name]


def take(motors: Motors, rows: NDArray[np.intp]) -> Motors:
    """Return the candidates ``rows``."""
    return {kind: values[rows] for kind, values in motors.items()}


def actuators_of(motors: Motors, joints: int) -> Actuators:
    """Return the actuators (n, joints) of candidates, friction and damping of the description included."""
    fields = {kind_of(name).field: values for name, values in motors.items()}
    spread = {
        field: np.ascontiguousarray(np.broadcast_to(values, (len(values), joints)))
        for field, values in fields.items()
        if field is not None
    }
    delays = [spread[field].max(initial=0.0) for field in ("command_delay", "sensor_delay") if field in spread]
    return Actuators(**spread, max_delay=np.array([[max(delays)]]) if delays else None)


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Unknowns of the logged joints; points are (unknowns,)."""

    joints: int
    names: tuple[tuple[str, int | None], ...]
    """Kind and joint of each; the joint is None if all joints share it."""
    scale: Float64
    """Typical sizes, powers of 2: points over them are exact, so that a fit resumes bit-identically."""
    inertia: Float64
    """Typical inertia that the joints show without armature (joints,)."""
    known: Motors = field(default_factory=dict)
    """Values (1, joints or 1) of kinds that are known, in place of ideal ones."""

    @classmethod
    def of(
        cls,
        links: Float64,
        armature: Float64,
        effort: Float64,
        speed: Float64,
        payload: bool,
        known_strength: Sequence[int] = (),
    ) -> Unknowns:
        """Return the unknowns of joints.

        Parameters are typical values (joints,): inertia of the links and of the motor, and root mean squares of effort
        and speed. Joints in ``known_strength`` have strength 1.
        """
        typical = {"inertia": links + armature, "damping": effort / speed, "effort": effort}
        names, scale = list[tuple[str, int | None]](), list[float]()
        for name, kind in KINDS.items():
            if name == "payload" and not payload:
                continue
            numbers = [each for each in range(len(links)) if name != "strength" or each not in known_strength]
            size = np.broadcast_to(typical[kind.size] if isinstance(kind.size, str) else kind.size, len(links))
            names += [(name, number) for number in numbers] if kind.per_joint else [(name, None)]
            scale += size[numbers].tolist() if kind.per_joint else [size[0]]
        return cls(len(links), tuple(names), _rounded(np.array(scale)), links)

    def plus(self, kinds: Sequence[str], joints: Sequence[int], sizes: Mapping[str, Float64]) -> Unknowns:
        """Return more unknowns: ``kinds`` of :data:`ADDED` of ``joints``; ``sizes`` are typical values (joints,)."""
        names = [(name, joint) for name in kinds for joint in joints]
        scale = np.array([self._size(name, sizes)[joint] for name, joint in names])
        return replace(self, names=(*self.names, *names), scale=np.append(self.scale, _rounded(scale)))

    def tries(self, theta: Float64, kinds: Sequence[str], sizes: Mapping[str, Float64]) -> Float64:
        """Return the points (n, unknowns) to try first: values of ``kinds`` appended to ``theta``."""
        rows = []
        for factors in product(*(ADDED[name].tries for name in kinds)):
            values = [
                (factor * self._size(name, sizes))[self.joints_of(name)]
                for name, factor in zip(kinds, factors, strict=True)
            ]
            rows.append(np.concatenate([theta, *values]))
        return self.clip(np.array(rows))

    def _size(self, name: str, sizes: Mapping[str, Float64]) -> Float64:
        size = kind_of(name).size
        return np.broadcast_to(sizes[size] if isinstance(size, str) else size, self.joints)

    def without(self, known: Motors) -> Unknowns:
        """Return the unknowns without the kinds in ``known``, which keep these values (1, joints or 1)."""
        kept = [index for index, (name, _) in enumerate(self.names) if name not in known]
        return replace(self, names=tuple(self.names[index] for index in kept), scale=self.scale[kept], known=known)

    def plus_known(self, names: tuple[tuple[str, int | None], ...]) -> Unknowns:
        """Return the unknowns with ``names`` added. Their kinds are no longer known."""
        known = {kind: values for kind, values in self.known.items() if kind not in dict(names)}
        scale = np.append(self.scale, np.ones(len(names)))
        return replace(self, names=(*self.names, *names), scale=scale, known=known)

    def _each(self, leaf: str) -> Float64:
        return np.array([getattr(kind_of(kind), leaf) for kind, _ in self.names])

    @property
    def low(self) -> Float64:
        """Lower bounds."""
        return self._each("low")

    @property
    def high(self) -> Float64:
        """Upper bounds."""
        return self._each("high")

    @property
    def spread(self) -> Float64:
        """Standard deviations of the prior, which matter only for unknowns that the log does not show."""
        return self._each("spread") * self.scale

    @property
    def prior(self) -> Float64:
        """Means of the prior."""
        return self._each("start")

    @property
    def per_joint(self) -> list[str]:
        """Kinds of unknowns of joints."""
        return list(dict.fromkeys(kind for kind, joint in self.names if joint is not None))

    def of_kind(self, name: str) -> NDArray[np.intp]:
        """Return the places of the unknowns of a kind in a point."""
        return np.flatnonzero([kind == name for kind, _ in self.names])

    def joints_of(self, name: str) -> list[int]:
        """Return the joints that have an unknown of a kind; [0] if all joints share it."""
        return [joint or 0 for kind, joint in self.names if kind == name]

    def changes(self, theta: Float64) -> Float64:
        """Return the changes (changes, unknowns) for finite differences at ``theta``.

        If inertia, damping, friction and bias grow with the strength of a motor, its joint moves in the same way, apart
        from the coupling of joints. So each strength is changed together with them, and the difference shows the
        coupling.
        """
        steps = np.maximum(_STEP * np.abs(theta), 0.5 * _STEP * self.scale)
        table, places = np.diag(steps), {name: at for at, name in enumerate(self.names)}
        for (kind, joint), at in places.items():
            if kind in SCALES and joint is not None:
                table[at, at] = _STRENGTH_STEP * theta[at]
                for own in [places[name, joint] for name in SCALED if (name, joint) in places]:
                    inertia = self.inertia[joint] if self.names[own][0] == "armature" else 0.0
                    table[at, own] = _STRENGTH_STEP * (theta[own] + inertia)
        return table

    def clip(self, theta: Float64) -> Float64:
        """Return ``theta`` within the bounds."""
        return np.clip(theta, self.low, self.high)

    def point(self, motors: Motors) -> Float64:
        """Return the point of one candidate; missing unknowns have their values at the start of a fit."""
        point = self.prior
        if "gain" not in motors and "strength" in motors:  # a regression calls it so
            motors = motors | {"gain": motors["strength"]}
        for kind, values in motors.items():
            joints = self.joints_of(kind)
            point[self.of_kind(kind)] = values[0][joints] if values.shape[1] > 1 else values[0]
        return point

    def motors(self, points: Float64) -> Motors:
        """Return the candidates at ``points`` (n, unknowns). Kinds that are not unknowns have ideal or known values."""
        named = {*dict(self.names), *self.known}
        kinds = KINDS | {name: kind for name, kind in ADDED.items() if name in named}
        found = {}
        for name, kind in kinds.items():
            joints = self.joints_of(name)
            ideal = np.full((1, self.joints if kind.per_joint and joints else 1), kind.neutral)
            found[name] = np.repeat(self.known.get(name, ideal), len(points), axis=0)
            found[name][:, joints] = points[:, self.of_kind(name)]
        return found


def _rounded(sizes: Float64) -> Float64:
    """Return the nearest powers of 2."""
    return np.exp2(np.round(np.log2(sizes)))
