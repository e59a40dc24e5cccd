r"""Diagnosis of the robot's model in a fit: links with wrong masses, and the part of the logs that disagrees most.

Required efforts are linear in the mass m and the first moment m c of every link, and in its inertia tensor (C. G.
Atkeson, C. H. An and J. M. Hollerbach, "Estimation of inertial parameters of manipulator loads and links", Int. J.
Robotics Research 5(3), 1986). With the tables of :mod:`batchpid.sim.identification.regression` and motors of strength
1, the efforts of all joints obey::

    u - b - (M q'' + h) = A q'' + B q' + F sgn(q') + sum over links of columns x

There are two regressions: x are changes of the mass and first moment of every link, or x scales the mass of one link,
with its shape unchanged. The first shows how much free masses would explain, the second which link is wrong. A heavier
link and a weaker motor may explain a log equally well; both are then reported. Every fourth half second is held out and
decides. Outliers have little weight (P. J. Huber, "Robust estimation of a location parameter", Annals of Mathematical
Statistics 35, 1964).
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Document, Float64
from batchpid.sim.identification.log import Log
from batchpid.sim.identification.plant import Plant
from batchpid.sim.identification.regression import LEAST_ROWS, STRENGTHS, Motion, Regression, required_efforts
from batchpid.task_space.rigid_tree import RigidTree

SPREAD, MOMENT_SPREAD = 0.5, 0.05
"""Standard deviations of the priors: of the relative change of a link's mass if some links change, and of the center
of mass [m] if all masses are free."""
DECREASE, LEAST_EXPLAINED = 0.03, 0.5
"""Smallest relative decrease of the residual, and smallest explained share of the efforts, for a report of a link."""
ALIKE = 1.1
"""Largest ratio of the residuals of two explanations that count as equally good."""
LEAST_RESIDUAL = 1e-3
"""Residual, over the joint's effort, below which a decrease is not significant."""
LEAST_CHANGE = 0.05
"""Smallest relative change of a link's mass that is reported."""
MOST_LINKS = 3
SLOW = 0.02
"""Speed below which a joint may stick, over the root mean square speed."""
STRETCH, STANDS_OUT, SHARE = 0.25, 5.0, 0.3
"""Length of a part of a log [s]. It is a disturbance if the ratios of its residual to the median of all parts and
to the joint's efforts are at least as large."""
_HUBER, _ROUNDS = 2.0, 6


class Disturbance(NamedTuple):
    """Part of a log in which the efforts disagree most with the model."""

    log: str
    """Source of the log."""
    time: float
    """Middle of the part [s], as in the log."""
    joint: str
    effort: float
    """Root mean square of the effort that the model does not explain there [N m or N]."""
    ratio: float
    """Ratio of ``effort`` to the median of all parts, for this joint."""


class Diagnosis(NamedTuple):
    """Share of the efforts that the model explains, and changes of the model that would explain more."""

    explained: tuple[float, float]
    """Share of the efforts on the held-out part that is explained, 1 - |residual| / |effort|, with the masses of the
    description, and with free masses and first moments."""
    links: dict[str, float]
    """Factors of the mass of links that seem lighter or heavier than described."""
    strengths: Float64 | None
    """Strengths (joints,) that explain the efforts as well as ``links`` do, or None."""
    disturbance: Disturbance | None

    def to_dict(self) -> Document:
        """Return plain values."""
        return {
            "effort_explained": list(self.explained),
            "mass_factors": self.links,
            "or_strengths": None if self.strengths is None else self.strengths.tolist(),
            "disturbance": None if self.disturbance is None else self.disturbance._asdict(),
        }

    def sentences(self) -> list[str]:
        """Return the diagnosis as sentences."""
        described, free = (100 * max(each, 0.0) for each in self.explained)
        found = [f"the efforts of the motion are explained to {described:.3g} %"]
        if self.links:
            links = " and ".join(
                f"link {name} seems {100 * abs(factor - 1):.0f} % {'heavier' if factor > 1 else 'lighter'}"
                for name, factor in self.links.items()
            )
            found = [
                f"with free masses the efforts are explained to {free:.3g} % instead of {described:.3g} %; {links} "
                "than in the robot's description"
            ]
        if self.strengths is not None:
            listed = ", ".join(f"{each:.2g}" for each in self.strengths)
            found.append(f"or the motors have strengths of {listed}: these logs do not tell which; weigh the link")
        if (one := self.disturbance) is not None:
            found.append(
                f"at {one.time:.1f} s of {one.log} the effort of {one.joint!r} is off by {one.effort:.3g}, "
                f"{one.ratio:.2g} times the usual: contact, a push or a stop? If so, leave that stretch out"
            )
        return found


def diagnose(regression: Regression, logs: list[Log], joints: list[str]) -> Diagnosis:
    """Return the diagnosis of the model in a ``regression`` of ``logs``, at its best delay and payload.

    ``joints`` are the names of the logged joints.
    """
    system = _System(regression)
    described = system.solve(np.zeros((system.rows, system.joints, 0)))
    tree = regression.plants[0].tree
    own = [tree.links[k] for k, body in enumerate(tree.link_bodies) if body >= 0 and tree.mass[k] > 0]
    own = [link for link in own if all(link in plant.tree.links for plant in regression.plants)]
    scaled = {link: system.columns(link, 1.0) for link in own}
    moments = [system.columns(link, 0.0, MOMENT_SPREAD * axis) for link in own for axis in np.eye(3)]
    masses = system.solve(np.concatenate([*scaled.values(), *moments], axis=2), 1.0)
    links, best = _heavier(system, scaled, described)
    strong, strengths = system.with_strengths()
    if links and (strong.held_out * ALIKE < best.held_out or best.explained < LEAST_EXPLAINED):
        links, best = {}, described  # the motors explain the efforts better, or neither does
    alike = bool(links) and strong.held_out <= ALIKE * best.held_out
    least = min((described, best, strong), key=lambda each: each.held_out)
    explained = described.explained, max(masses.explained, best.explained)
    return Diagnosis(explained, links, strengths if alike else None, system.disturbance(least, logs, joints))


class _Solved(NamedTuple):
    """Solution of a regression."""

    values: Float64
    """Values of the further columns."""
    residual: Float64
    """(rows, joints)."""
    held_out: float
    """Geometric mean over joints of the residual of the held-out rows, over the joint's effort."""
    explained: float


class _System:
    """Regression of all joints together."""

    def __init__(self, regression: Regression) -> None:
        self.regression, best = regression, regression.best.motors
        self._required, a, v, sign, self._effort = regression.tables(best["delay"][0, 0], best["payload"][0, 0])
        self.rows, self.joints = a.shape
        self._motion = np.stack([a, v, sign, np.ones_like(a)], axis=2)
        fast = np.abs(v) > SLOW * np.sqrt((v**2).mean(0))
        self._moves = fast | (fast.sum(0) < LEAST_ROWS)
        stretch = round(2 * STRETCH / regression.plants[0].drive.timestep)
        self._held_out = np.concatenate([(rows // stretch) % 4 == 3 for rows, *_ in self._of_logs()])
        self._size = np.sqrt((self._effort**2).mean(0)) + 1e-9

    def _of_logs(self) -> list[tuple[NDArray[np.intp], Motion, Plant]]:
        return list(zip(self.regression.rows, self.regression.motions, self.regression.plants, strict=True))

    def columns(self, link: str, more: float = 0.0, further: Float64 | float = 0.0) -> Float64:
        """Return the change of the required efforts (rows, joints, 1) due to a change of a link.

        Its mass and inertia grow by the share ``more``, and its center of mass moves by ``further`` (3,) [m].
        """
        found = []
        for (rows, motion, plant), described in zip(self._of_logs(), self._described, strict=True):
            changed = plant.with_tree(_changed(plant.tree, link, more, further))
            found.append(required_efforts(changed, motion, rows, 0.0) - described)
        return np.concatenate(found)[..., None]

    @cached_property
    def _described(self) -> list[Float64]:
        """Required efforts (rows, joints) of each log with the links as described."""
        return [required_efforts(plant, motion, rows, 0.0) for rows, motion, plant in self._of_logs()]

    def solve(self, further: Float64, spread: Float64 | float = SPREAD) -> _Solved:
        """Return the solution with ``further`` columns (rows, joints, n), which all joints share."""
        count, shared = 4 * self.joints, further.shape[2]
        target = self._effort - self._required
        residual = target
        for _ in range(_ROUNDS):
            size = self._spread_of(residual)
            small = np.minimum(1.0, _HUBER * size / (np.abs(residual) + 1e-12))
            root = np.sqrt(small) / size
            factors = [np.diag(np.r_[np.full(count, 1e-6), 1 / np.broadcast_to(spread, shared)])]
            rhs = [np.zeros(count + shared)]
            for joint in range(self.joints):
                rows = ~self._held_out & self._moves[:, joint]
                matrix = np.zeros((rows.sum(), count + shared))
                matrix[:, 4 * joint : 4 * joint + 4] = self._motion[rows, joint]
                matrix[:, count:] = further[rows, joint]
                factors.append(root[rows, joint, None] * matrix)
                rhs.append(root[rows, joint] * target[rows, joint])
            found = _bounded(np.vstack(factors), np.concatenate(rhs), count)
            own = found[:count].reshape(self.joints, 4)
            residual = target - (self._motion * own).sum(2) - further @ found[count:]
        return self._solved(found[count:], residual)

    def with_strengths(self) -> tuple[_Solved, Float64]:
        """Return the solution with free strengths, at joints where logs determine them, and the strengths (joints,)."""
        free = np.diag(~self.regression.ratios_only)
        found = self.solve(self._effort[..., None] * free)  # (1 - strength) times the effort
        strengths = np.clip(1 - found.values, *STRENGTHS)
        return self._solved(found.values, found.residual / strengths), strengths

    def _spread_of(self, residual: Float64) -> Float64:
        """Return a robust standard deviation of the fitted residuals (joints,), from their median."""
        each = np.where(self._moves & ~self._held_out[:, None], np.abs(residual), np.nan)
        size: Float64 = 1.4826 * np.nanmedian(each, axis=0) + 1e-6 * self._size
        return size

    def _solved(self, values: Float64, residual: Float64) -> _Solved:
        kept = self._moves & self._held_out[:, None]
        squares = np.where(kept, residual / self._size, 0.0) ** 2
        of_joints = np.sqrt(squares.sum(0) / np.maximum(kept.sum(0), 1))
        left, whole = (float(np.linalg.norm(np.where(kept, each, 0.0))) for each in (residual, self._effort))
        held_out = float(np.exp(np.log(of_joints + LEAST_RESIDUAL).mean()))
        return _Solved(values, residual, held_out, float(1 - left / max(whole, 1e-12)))

    def disturbance(self, solved: _Solved, logs: list[Log], joints: list[str]) -> Disturbance | None:
        """Return the part with the largest residual over the median of all parts; None if none is large enough."""
        dt, begin = self.regression.plants[0].drive.timestep, 0
        stretches: list[tuple[int, float, Float64]] = []
        for log, (rows, *_) in enumerate(self._of_logs()):
            part = solved.residual[begin : begin + len(rows)]
            begin += len(rows)
            pieces = max(1, round((rows[-1] - rows[0]) * dt / STRETCH))
            for at, piece in zip(np.array_split(rows, pieces), np.array_split(part, pieces), strict=True):
                stretches.append((log, float(at.mean()) * dt, np.sqrt((piece**2).mean(0))))
        sizes = np.array([size for _, _, size in stretches])
        median: Float64 = np.median(sizes, axis=0)
        ratio = sizes / (median + 1e-3 * self._size)
        ratio = np.where(sizes > SHARE * self._size, ratio, 0.0)
        stretch, joint = np.unravel_index(int(ratio.argmax()), ratio.shape)
        if ratio[stretch, joint] < STANDS_OUT:
            return None
        log, time, size = stretches[stretch]
        where = logs[log].source, float(logs[log].time[0] + time), joints[joint]
        return Disturbance(*where, float(size[joint]), float(ratio[stretch, joint]))


def _heavier(system: _System, scaled: dict[str, Float64], described: _Solved) -> tuple[dict[str, float], _Solved]:
    """Return mass factors of links, added one by one while the residual falls enough, and the solution."""
    chosen, best = list[str](), described
    while len(chosen) < MOST_LINKS:
        tried = {
            name: system.solve(np.concatenate([scaled[each] for each in (*chosen, name)], axis=2))
            for name in scaled
            if name not in chosen
        }
        if not tried:
            break
        name = min(tried, key=lambda each: tried[each].held_out)
        if tried[name].held_out > (1 - DECREASE) * best.held_out:
            break
        chosen, best = [*chosen, name], tried[name]
    factors = {name: float(1 + value) for name, value in zip(chosen, best.values, strict=True)}
    return {name: each for name, each in factors.items() if abs(each - 1) > LEAST_CHANGE and each > 0}, best


def _changed(tree: RigidTree, link: str, more: float, further: Float64 | float) -> RigidTree:
    mass, center, inertia = tree.mass.copy(), tree.center.copy(), tree.inertia.copy()
    index = tree.index(link)
    mass[index] *= 1 + more
    inertia[index] *= 1 + more
    center[index] += further
    return replace(tree, mass=mass, center=center, inertia=inertia)


def _bounded(matrix: Float64, target: Float64, count: int) -> Float64:
    """Return the least squares with armature, damping and friction of at least 0 among the first ``count``."""
    from scipy.optimize import lsq_linear

    factor: Any = np.linalg.qr(np.column_stack([matrix, target]), mode="r")
    low = np.full(matrix.shape[1], -np.inf)
    low[:count].reshape(-1, 4)[:, :3] = 0.0
    scale = np.maximum(np.abs(factor[:, :-1]).max(0), 1e-12)
    found = lsq_linear(factor[:, :-1] / scale, factor[:, -1], (low, np.inf)).x
    return np.asarray(found / scale, np.float64)
