"""Inertias of simulated bodies, from the inertias of the links of the URDF that they consist of."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.sim.engine.sapien.building import center_of_mass, merged
from batchpid.sim.engine.scene_spec import SceneSpec, Variation
from batchpid.sim.robot.merging import place_links
from batchpid.task_space.spatial_inertia import SpatialInertia, rotation_matrix, total

NO_MASS = 1e-6
"""Mass [kg] that SAPIEN gives a link without mass."""


class Part(NamedTuple):
    """Link of the URDF in the simulated body that it is part of."""

    inertia: SpatialInertia
    """In the frame of the body."""
    axes: Float64
    """Axes of the link's frame in the body's frame, as columns (3, 3)."""
    column: int | None
    """Number among the links that vary; None for a link that does not."""


class Body(NamedTuple):
    """Links of a simulated body, and the place of the payload in its frame (3,) [m]; None without."""

    parts: list[Part]
    payload: Float64 | None


def body_inertias(spec: SceneSpec) -> dict[str, SpatialInertia]:
    """Return the inertia of every simulated body of ``spec``, by name, in the frame of the body."""
    parts = _parts(spec, ())
    return {name: total([part.inertia for part in members]) for name, members in parts.items()}


def simulated_bodies(spec: SceneSpec) -> tuple[str, dict[str, SpatialInertia]]:
    """Return the URDF of the simulated bodies of ``spec``, and their inertias."""
    return merged(spec).urdf if spec.merge_fixed else spec.urdf, body_inertias(spec)


def varied_bodies(spec: SceneSpec, carrier: str, links: Sequence[str]) -> dict[str, Body]:
    """Return the simulated bodies with varying mass, by name: the bodies of ``links`` and of ``carrier``."""
    loaded, place = center_of_mass(spec, carrier)
    return {
        body: Body(members, place if body == loaded else None)
        for body, members in _parts(spec, links).items()
        if body == loaded or any(part.column is not None for part in members)
    }


def _parts(spec: SceneSpec, links: Sequence[str]) -> dict[str, list[Part]]:
    """Return the links with mass of every simulated body; bodies without get one part of ``NO_MASS``."""
    placements, inertias = place_links(spec.urdf, spec.merge_fixed), merged(spec).inertias
    parts: dict[str, list[Part]] = defaultdict(list)
    for name, at in placements.items():
        members = parts[at.link]
        if name in inertias and inertias[name].mass > 0:
            inertia, axes = inertias[name].moved(at.position, at.wxyz), rotation_matrix(at.wxyz)
            members.append(Part(inertia, axes, links.index(name) if name in links else None))
    nothing = Part(SpatialInertia(NO_MASS, np.zeros(3), NO_MASS * np.eye(3)), np.eye(3), None)
    return {name: members or [nothing] for name, members in parts.items()}


def varied_inertia(body: Body, variation: Variation, row: int) -> SpatialInertia:
    """Return the inertia of a body with its links scaled, and with the payload."""
    parts = []
    for part in body.parts:
        (mass, center, tensor), column, share = part.inertia, part.column, 1.0
        if variation.link_mass is not None and column is not None:
            share = float(np.nan_to_num(variation.link_mass[row, column], nan=1.0))
        if variation.center_of_mass is not None and column is not None:
            displacement = variation.center_of_mass[row, 3 * column : 3 * column + 3]
            center = center + part.axes @ np.nan_to_num(displacement)
        parts.append(SpatialInertia(share * mass, center, share * tensor))
    if body.payload is not None and variation.payload is not None:
        parts.append(SpatialInertia(float(variation.payload[row]), body.payload, np.zeros((3, 3))))
    return total(parts)
