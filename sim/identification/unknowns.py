"""Unknowns of a fit: a table of their kinds, their names, scales, bounds and weak priors, and the motors at a point."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Float64
from batchpid.motors.actuator_fields import FIELDS
from batchpid.motors.actuators import Actuators

Motors = dict[str, Float64]
"""Values of n candidates by kind of unknown: (n, joints), or (n, 1) where all joints share it."""


class Kind(NamedTuple):
    """Kind of unknown, in SI units."""

    field: str | None
    """Field of :class:`batchpid.Actuators`; None: of the plant, :mod:`batchpid.sim.identification.plant`."""
    per_joint: bool
    low: float
    high: float
    size: str | float
    """Typical size: a number, or the name of a typical value of each joint, as of :meth:`Unknowns.of`."""
    spread: float
    """Standard deviation of the prior, over the typical size."""
    start: float = 0.0
    """Mean of the prior, and value at the start of a fit where the regression does not give it."""

    @property
    def neutral(self) -> float:
        """Value of ideal motors."""
        return 0.0 if self.field is None else FIELDS[self.field].neutral


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
"""Kinds of unknowns. A line here is all that an effect of :mod:`batchpid.motors` needs to be identified."""
ADDED = {"lag": Kind("lag", True, 0.0, 0.1, 5e-3, 20.0)}
"""Kinds that a fit has only where it is asked for them; they stay out of simulations otherwise."""
DESCRIBED = ("damping", "friction")
"""Kinds of which the robot's description states a share, under the same name; here they are the whole."""
_STEP = 2e-3
"""Change of an unknown for a finite difference, in units of its scale."""
_STRENGTH_STEP = 1e-2
"""Change of a strength, over it."""


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
    """Kind and joint of each, None where all joints share it."""
    scale: Float64
    """Typical sizes, powers of 2: points over them are exact, so that a fit resumes bit-identically."""
    inertia: Float64
    """Typical inertia that the joints show without armature (joints,)."""
    known: Motors = field(default_factory=dict)
    """Values (1, joints or 1) of kinds that are known, in place of ideal ones."""

    @classmethod
    def of(cls, links: Float64, armature: Float64, effort: Float64, speed: Float64, payload: bool) -> Unknowns:
        """Return the unknowns of joints.

        Parameters are typical values (joints,): inertia of the links and of the motor, and root mean squares of effort
        and speed.
        """
        typical = {"inertia": links + armature, "damping": effort / speed, "effort": effort}
        names, scale = list[tuple[str, int | None]](), list[float]()
        for name, kind in KINDS.items():
            if name == "payload" and not payload:
                continue
            numbers = range(len(links)) if kind.per_joint else [None]
            size = typical[kind.size] if isinstance(kind.size, str) else kind.size
            names += [(name, number) for number in numbers]
            scale += np.broadcast_to(size, len(numbers)).tolist()
        return cls(len(links), tuple(names), np.exp2(np.round(np.log2(np.array(scale)))), links)

    def without(self, known: Motors) -> Unknowns:
        """Return the unknowns without the kinds in ``known``, whose values (1, joints or 1) are taken as they are."""
        kept = [index for index, (name, _) in enumerate(self.names) if name not in known]
        return replace(self, names=tuple(self.names[index] for index in kept), scale=self.scale[kept], known=known)

    def plus_known(self, names: tuple[tuple[str, int | None], ...]) -> Unknowns:
        """Return the unknowns with ``names`` among them, whose kinds are known no longer."""
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
        """Kinds of unknowns of each joint."""
        return [kind for kind, joint in self.names if joint == 0]

    def of_kind(self, name: str) -> NDArray[np.intp]:
        """Return the places of the unknowns of a kind in a point."""
        return np.flatnonzero([kind == name for kind, _ in self.names])

    def changes(self, theta: Float64) -> Float64:
        """Return the changes (changes, unknowns) for finite differences at ``theta``.

        If inertia, damping, friction and bias grow with the strength of a motor, its joint moves in the same way, apart
        from the coupling of joints. So each strength is changed together with them, and the difference shows the
        coupling.
        """
        steps = np.maximum(_STEP * np.abs(theta), 0.5 * _STEP * self.scale)
        table, strengths = np.diag(steps), self.of_kind("strength")
        table[strengths, strengths] = _STRENGTH_STEP * theta[strengths]
        for kind in ("armature", "damping", "friction", "bias"):
            own = self.of_kind(kind)
            if len(own) != len(strengths):
                continue
            table[strengths, own] = _STRENGTH_STEP * (theta[own] + (self.inertia if kind == "armature" else 0.0))
        return table

    def clip(self, theta: Float64) -> Float64:
        """Return ``theta`` within the bounds."""
        return np.clip(theta, self.low, self.high)

    def point(self, motors: Motors) -> Float64:
        """Return the point of one candidate; unknowns that it lacks are those at the start of a fit."""
        point = self.prior
        for kind, values in motors.items():
            own = self.of_kind(kind)
            point[own] = values[0, : len(own)]
        return point

    def motors(self, points: Float64) -> Motors:
        """Return the candidates at ``points`` (n, unknowns), ideal in what is not an unknown."""
        ideal = {name: np.full((len(points), 1), kind.neutral) for name, kind in KINDS.items()}
        known = {name: np.repeat(values, len(points), axis=0) for name, values in self.known.items()}
        return ideal | known | {kind: points[:, self.of_kind(kind)] for kind in dict(self.names)}
