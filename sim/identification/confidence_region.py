r"""Joint confidence region of identified motors: its place in an actuators file, and draws from it.

The estimates of a fit are correlated: a higher strength comes with more armature and friction. With the estimate m,
the standard deviations d and the correlations R, the region is the ellipsoid with 95 % of the normal distribution::

    theta = m + d * (R^1/2 z),     |z|^2 <= chi^2_0.95(n)

Draws are normal, within the ellipsoid and the bounds of the unknowns. The quantile of chi^2 is approximated as in
E. B. Wilson and M. M. Hilferty, "The distribution of chi-square", PNAS 17, 1931.
"""

from __future__ import annotations

import os
from typing import NamedTuple

import numpy as np

import batchpid as bp
from batchpid.arrays.array_types import Document, Float64
from batchpid.errors import InvalidArgumentError
from batchpid.io import documents
from batchpid.sim.identification.unknowns import ADDED, DESCRIBED, KINDS, kind_of
from batchpid.sim.robot.actuator_checks import load_robot_actuators
from batchpid.sim.robot.robot import Robot

KEY = "confidence_region"
"""Key of an actuators file, under "about"."""
OUTSIDE = 0.05
"""Probability of the points outside a region."""


class Region(NamedTuple):
    """Joint confidence region of n unknowns."""

    names: tuple[tuple[str, str | None], ...]
    """Kind and joint of each unknown; the joint is None if all joints share it."""
    estimate: Float64
    deviation: Float64
    """Standard deviations (n,)."""
    correlation: Float64
    """(n, n)."""

    def to_dict(self) -> Document:
        """Return plain values for :func:`read_region`, with the lower triangle of the correlations."""
        rows = [[float(f"{each:.5f}") for each in row[: k + 1]] for k, row in enumerate(self.correlation)]
        return {
            "unknowns": [[kind] if joint is None else [kind, joint] for kind, joint in self.names],
            "estimate": self.estimate.tolist(),
            "standard_deviation": self.deviation.tolist(),
            "correlation": rows,
        }

    def draw(self, count: int, seed: int) -> tuple[Float64, Float64]:
        """Return ``count`` points (count, n) of the region, and their distances from the estimate in deviations."""
        from scipy.special import chdtri

        size, rng = len(self.names), np.random.default_rng(seed)
        values, vectors = np.linalg.eigh(self.correlation)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        largest = chdtri(size, OUTSIDE)
        z = np.zeros((0, size))
        while len(z) < count:
            tried = rng.normal(size=(count, size))
            z = np.concatenate([z, tried[(tried**2).sum(1) <= largest]])
        low, high = (np.array([getattr(kind_of(kind), end) for kind, _ in self.names]) for end in ("low", "high"))
        points = np.clip(self.estimate + self.deviation * (z[:count] @ root.T), low, high)
        return points, (points - self.estimate) / np.maximum(self.deviation, 1e-300)


class DrawnMotors(NamedTuple):
    """Motors drawn from a region."""

    region: Region
    points: Float64
    """(draws, unknowns)."""
    distance: Float64
    """Distances of the points from the estimate (draws, unknowns), in standard deviations."""
    actuators: bp.Actuators
    """One row for each draw."""

    def describe(self, draw: int, joint: str) -> str:
        """Return the values of a draw for ``joint`` that deviate most from the estimate, three of them."""
        own = [n for n, (kind, of) in enumerate(self.region.names) if of in (None, joint) and kind_of(kind).field]
        farthest = sorted(own, key=lambda n: -abs(self.distance[draw, n]))[:3]
        return ", ".join(
            f"{self.region.names[n][0]} {self.points[draw, n]:.3g} ({self.distance[draw, n]:+.1f} sd)" for n in farthest
        )


def read_region(path: str | os.PathLike[str], robot: Robot) -> Region:
    """Return the region in an actuators file of ``robot``.

    Raises InvalidArgumentError if the file has no region or an invalid one, and FileNotFoundError without a file.
    """
    document = documents.read(path)
    about = document.get("about") if isinstance(document, dict) else None
    known = about.get(KEY) if isinstance(about, dict) else None
    source, remedy = f"{path}: {KEY}", "write the file with `batchpid identify` of this version"
    if not isinstance(known, dict):
        raise InvalidArgumentError(source, "is missing", remedy=remedy)
    try:
        names = tuple((str(each[0]), str(each[1]) if len(each) > 1 else None) for each in known["unknowns"])
        estimate, deviation = (np.array(known[name], float) for name in ("estimate", "standard_deviation"))
        correlation = np.zeros((len(names), len(names)))
        for k, row in enumerate(known["correlation"]):
            correlation[k, : k + 1] = correlation[: k + 1, k] = row
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise InvalidArgumentError(source, f"cannot be read ({error})", remedy=remedy) from None
    right = estimate.shape == deviation.shape == (len(names),) and bool(np.isfinite([*estimate, *deviation]).all())
    right = right and bool((deviation >= 0).all() and (np.abs(correlation) <= 1).all()) and len(names) > 0
    right = right and np.allclose(np.diagonal(correlation), 1.0)
    right = right and len({*names}) == len(names) and all(len(each) <= 2 for each in known["unknowns"])
    if not right or any(kind not in KINDS | ADDED for kind, _ in names):
        raise InvalidArgumentError(source, "has wrong shapes, numbers or unknowns", remedy=remedy)
    if strangers := sorted({joint for _, joint in names if joint} - set(robot.joint_names)):
        raise InvalidArgumentError(source, f"is of other joints: {', '.join(strangers)}", remedy="name their robot")
    return Region(names, estimate, deviation, correlation)


def draw_motors(path: str | os.PathLike[str], robot: Robot, count: int, seed: int = 0) -> DrawnMotors:
    """Return ``count`` sets of motors of ``robot``, drawn from the region in an actuators file.

    Effects outside the region keep their values in the file. Friction and damping are in addition to the robot's
    description, at least 0. A payload at the tool is left out. Raises as :func:`read_region`.
    """
    region, nominal = read_region(path, robot), load_robot_actuators(str(path), robot)
    points, distance = region.draw(count, seed)
    columns: dict[str, Float64] = {}
    for n, (kind, joint) in enumerate(region.names):
        field = kind_of(kind).field
        if field is None:
            continue
        if field not in columns:
            leaf = getattr(nominal, field)
            columns[field] = np.full(
                (count, robot.dof), kind_of(kind).neutral if leaf is None else np.array(leaf, float)
            )
        if joint is None:
            columns[field][:] = points[:, n, None]
            continue
        number = robot.joint_names.index(joint)
        described = getattr(robot, kind)[number] if kind in DESCRIBED else None
        value = points[:, n] if described is None else np.maximum(points[:, n] - described, 0.0)
        columns[field][:, number] = value
    if nominal.num_joints is None:
        nominal = bp.make_actuators(robot.dof, continuous=robot.continuous)
    return DrawnMotors(region, points, distance, nominal.replace(**columns))
