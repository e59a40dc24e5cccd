"""Unknowns of a fit: their names, units, scales, bounds and weak priors, and the motors at a point."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.sim.identification.plant import Motors

PER_JOINT = ("armature", "damping", "friction", "strength", "bias")
LIMITS = {
    "armature": (0.0, np.inf),
    "damping": (0.0, np.inf),
    "friction": (0.0, np.inf),
    "strength": (0.05, 5.0),
    "bias": (-np.inf, np.inf),
    "delay": (0.0, 0.09),
    "stopping": (5e-4, 0.1),
    "payload": (0.0, np.inf),
}
"""Bounds of each kind of unknown, SI units."""
_SPREAD = {
    "armature": 10.0,
    "damping": 10.0,
    "friction": 10.0,
    "strength": 0.5,
    "bias": 10.0,
    "delay": 20,
    "stopping": 4,
    "payload": 50,
}
_PRIOR = {"strength": 1.0, "stopping": 5e-3}
_STEP = 2e-3
"""Change of an unknown for a finite difference, in units of its scale."""
_STRENGTH_STEP = 1e-2
"""Change of a strength, over it."""


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Unknowns of the logged joints; points are (unknowns,)."""

    joints: int
    names: tuple[tuple[str, int | None], ...]
    """Kind and joint of each, None for delay and payload."""
    scale: Float64
    """Typical sizes, powers of 2: points over them are exact, so that a fit resumes bit-identically."""
    inertia: Float64
    """Typical inertia that the joints show without armature (joints,)."""

    @classmethod
    def of(cls, links: Float64, armature: Float64, effort: Float64, speed: Float64, payload: bool) -> Unknowns:
        """Return the unknowns of joints.

        Parameters are typical values (joints,): inertia of the links and of the motor, and root mean squares of effort
        and speed.
        """
        inertia = links + armature
        sizes = {
            "armature": inertia,
            "damping": effort / speed,
            "friction": effort,
            "strength": np.ones_like(inertia),
            "bias": effort,
        }
        names: list[tuple[str, int | None]] = [(kind, joint) for kind in PER_JOINT for joint in range(len(inertia))]
        scale = [*np.concatenate([sizes[kind] for kind in PER_JOINT]), 5e-3, 5e-3]
        names += [("delay", None), ("stopping", None)]
        if payload:
            names.append(("payload", None))
            scale.append(0.2)
        return cls(len(inertia), tuple(names), np.exp2(np.round(np.log2(np.array(scale, np.float64)))), links)

    @property
    def low(self) -> Float64:
        """Lower bounds."""
        return np.array([LIMITS[kind][0] for kind, _ in self.names])

    @property
    def high(self) -> Float64:
        """Upper bounds."""
        return np.array([LIMITS[kind][1] for kind, _ in self.names])

    @property
    def spread(self) -> Float64:
        """Standard deviations of the prior, which matter only for unknowns that the log does not show."""
        return np.array([_SPREAD[kind] for kind, _ in self.names]) * self.scale

    @property
    def prior(self) -> Float64:
        """Means of the prior: ideal motors."""
        return np.array([_PRIOR.get(kind, 0.0) for kind, _ in self.names])

    def changes(self, theta: Float64) -> Float64:
        """Return the changes (changes, unknowns) for finite differences at ``theta``.

        If inertia, damping, friction and bias grow with the strength of a motor, its joint moves in the same way, apart
        from the coupling of joints. So each strength is changed together with them, and the difference shows the
        coupling.
        """
        steps = np.maximum(_STEP * np.abs(theta), 0.5 * _STEP * self.scale)
        table, n = np.diag(steps), self.joints
        strengths = PER_JOINT.index("strength") * n + np.arange(n)
        table[strengths, strengths] = _STRENGTH_STEP * theta[strengths]
        for kind in ("armature", "damping", "friction", "bias"):
            own = PER_JOINT.index(kind) * n + np.arange(n)
            table[strengths, own] = _STRENGTH_STEP * (theta[own] + (self.inertia if kind == "armature" else 0.0))
        return table

    def clip(self, theta: Float64) -> Float64:
        """Return ``theta`` within the bounds."""
        return np.clip(theta, self.low, self.high)

    def point(self, motors: Motors) -> Float64:
        """Return the point of one candidate."""
        values = [
            *np.concatenate([getattr(motors, kind)[0] for kind in PER_JOINT]),
            motors.delay[0, 0],
            motors.stopping[0, 0],
        ]
        return np.array([*values, motors.payload[0, 0]] if len(self.names) > len(values) else values)

    def motors(self, points: Float64) -> Motors:
        """Return the candidates at ``points`` (n, unknowns)."""
        n, own = self.joints, len(PER_JOINT) * self.joints
        columns = {kind: points[:, k * n : (k + 1) * n] for k, kind in enumerate(PER_JOINT)}
        payload = points[:, own + 2 :] if points.shape[1] > own + 2 else np.zeros((len(points), 1))
        return Motors(**columns, delay=points[:, own : own + 1], stopping=points[:, own + 1 : own + 2], payload=payload)
