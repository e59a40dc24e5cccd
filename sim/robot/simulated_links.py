"""Simulated links of a robot, and their inertias: links of the URDF that fixed joints connect may be merged.

A link without ``<inertial>`` has the inertia of its collision shapes. Functions take the text of a sanitised URDF.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.sim.robot.collision_shapes import inertia_of, link_shapes
from batchpid.sim.robot.merging import Merged, merge_fixed_links, place_links
from batchpid.task_space.spatial_inertia import SpatialInertia, rotation_matrix, total

NO_MASS = 1e-6
"""Mass [kg] and moments of inertia [kg m^2] of a simulated link without mass, in both engines."""


class Part(NamedTuple):
    """Link of the URDF, as a part of a simulated body."""

    inertia: SpatialInertia
    """Inertia of the link in the frame of the body."""
    axes: Float64
    """Axes of the link's frame in the body's frame, as columns (3, 3)."""
    column: int | None
    """Index among the links that vary; None for a link that does not vary."""


class Body(NamedTuple):
    """Links of a simulated body, and the place of the payload in its frame (3,) [m]; None without payload."""

    parts: list[Part]
    payload: Float64 | None


@lru_cache(maxsize=16)
def simulated(urdf: str, merge_fixed: bool) -> Merged:
    """Return the simulated robot, with its fixed joints merged or not; its text has the inertia of every link."""

    def of_shapes(link: str) -> SpatialInertia:
        return inertia_of(link_shapes(urdf, False)[link])

    return merge_fixed_links(urdf, of_shapes, merge_fixed)


def body_inertias(urdf: str, merge_fixed: bool) -> dict[str, SpatialInertia]:
    """Return the inertia of every simulated link, by name, in its frame."""
    parts = _parts(urdf, merge_fixed, ())
    return {name: total([part.inertia for part in members]) for name, members in parts.items()}


def center_of_mass(urdf: str, merge_fixed: bool, link: str) -> tuple[str, Float64]:
    """Return the simulated link that contains ``link`` of the URDF, and in its frame the center of mass of ``link``.

    For a link without mass that is its origin.
    """
    at, inertia = place_links(urdf, merge_fixed)[link], simulated(urdf, merge_fixed).inertias.get(link)
    return at.link, at.position if inertia is None else inertia.moved(at.position, at.wxyz).center


def varied_bodies(urdf: str, merge_fixed: bool, carrier: str, links: Sequence[str]) -> dict[str, Body]:
    """Return the simulated links with varying mass, by name: they contain ``links`` or ``carrier``."""
    loaded, place = center_of_mass(urdf, merge_fixed, carrier)
    return {
        body: Body(members, place if body == loaded else None)
        for body, members in _parts(urdf, merge_fixed, links).items()
        if body == loaded or any(part.column is not None for part in members)
    }


def _parts(urdf: str, merge_fixed: bool, links: Sequence[str]) -> dict[str, list[Part]]:
    """Return the links with mass of every simulated body; a body without any gets one part of ``NO_MASS``."""
    placements, inertias = place_links(urdf, merge_fixed), simulated(urdf, merge_fixed).inertias
    parts: dict[str, list[Part]] = defaultdict(list)
    for name, at in placements.items():
        members = parts[at.link]
        if name in inertias and inertias[name].mass > 0:
            inertia, axes = inertias[name].moved(at.position, at.wxyz), rotation_matrix(at.wxyz)
            members.append(Part(inertia, axes, links.index(name) if name in links else None))
    nothing = Part(SpatialInertia(NO_MASS, np.zeros(3), NO_MASS * np.eye(3)), np.eye(3), None)
    return {name: members or [nothing] for name, members in parts.items()}
