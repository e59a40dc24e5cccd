"""Contacts of one robot at given poses, by its shapes in SAPIEN."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import lru_cache, wraps
from threading import RLock
from typing import Any, Concatenate, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from batchpid.sim.engine.sapien.building import build_scene, new_system, parse, rigid_bodies, shape_owners
from batchpid.sim.engine.sapien.collision_groups import Pair
from batchpid.sim.engine.sapien.extents import WORLD, NearPair
from batchpid.sim.engine.sapien.physics import PHYSICS
from batchpid.sim.engine.scene_spec import SceneSpec

P = ParamSpec("P")
T = TypeVar("T")


def _one_at_a_time(method: Callable[Concatenate[Contacts, P], T]) -> Callable[Concatenate[Contacts, P], T]:
    """Decorate a method to hold the lock of its object: methods set the pose of the robot and then read from it."""

    @wraps(method)
    def locked(self: Contacts, *args: P.args, **kwargs: P.kwargs) -> T:
        with self._lock:
            return method(self, *args, **kwargs)

    return locked


class Contacts:
    """Contacts of the robot of ``spec`` alone, at poses qpos (n, dof). Several threads may use one object."""

    def __init__(self, spec: SceneSpec) -> None:
        self._lock = RLock()
        spec = replace(spec, physics=PHYSICS["fast"], engine="sapien", timestep=1e-6, build=None)
        self._system = new_system(spec)
        self._scene, self._robot = build_scene(spec, self._system)
        self._links = {link: number for number, link in enumerate(self._robot.links)}
        self.links = [link.name for link in self._robot.links]
        owners, bodies = shape_owners(spec), rigid_bodies(parse(spec))
        self._owners = {
            shape: owner
            for link in self._robot.links
            for shape, owner in zip(link.collision_shapes, owners[link.name], strict=True)
        }
        # Rigid body of each link, by number; the last is the ground's (WORLD), which counts as the base.
        self._bodies = [bodies[link.name] for link in (*self._robot.links, self._robot.links[0])]

    @_one_at_a_time
    def in_contact(self, qpos: NDArray[Any], clearance: float = 0.0) -> NDArray[np.bool_]:
        """Return whether links are closer than ``clearance`` [m] to each other or to the ground (n,).

        Links joined by fixed joints do not count, nor the base and the links fixed to it with the ground.
        """
        bodies = self._bodies
        return np.array(
            [
                any(bodies[a] != bodies[b] and distance < clearance for a, b, distance in self.near_pairs(row))
                for row in np.asarray(qpos)
            ]
        )

    @_one_at_a_time
    def link_distances(self, qpos: NDArray[Any]) -> dict[Pair, float]:
        """Return the distances [m] of the pairs of links of the URDF that are near each other, at one pose (dof,).

        Links joined by fixed joints do not count. The ground counts as the base.
        """
        distances: dict[Pair, float] = {}
        for names, distance in self._near_links(qpos):
            pair = frozenset([*names, self._bodies[WORLD]][:2])
            distances[pair] = min(distance, distances.get(pair, np.inf))
        return distances

    @_one_at_a_time
    def nearest_links(self, qpos: NDArray[Any]) -> tuple[str, ...]:
        return min(self._near_links(qpos), key=lambda near: near[1], default=((), np.inf))[0]

    def _near_links(self, qpos: NDArray[Any]) -> Iterator[tuple[tuple[str, ...], float]]:
        """Yield the links of the URDF, one or two, and the distance [m] of each pair of shapes near each other."""
        self.near_pairs(qpos)
        for contact in self._system.get_contacts():
            first, second = (self._bodies[self._links.get(body, WORLD)] for body in contact.bodies)
            if first != second:
                names = tuple(self._owners[shape] for shape in contact.shapes if shape in self._owners)
                yield names, min(point.separation for point in contact.points)

    @_one_at_a_time
    def height(self, qpos: NDArray[Any], base_too: bool = False) -> float:
        self._robot.set_qpos(qpos.astype(np.float32))
        base = self._bodies[WORLD]
        links = (link for link, number in self._links.items() if base_too or self._bodies[number] != base)
        boxes = (link.compute_global_aabb_tight() for link in links if link.collision_shapes)
        return min((float(box[0, 2]) for box in boxes), default=np.inf)

    @_one_at_a_time
    def near_pairs(self, qpos: NDArray[Any]) -> list[NearPair]:
        """Return the pairs of shapes that the engine lists as near each other, at one pose (dof,)."""
        self._robot.set_qpos(qpos.astype(np.float32))
        self._robot.set_qvel(np.zeros(self._robot.dof, np.float32))
        self._system.step()
        pairs = []
        for contact in self._system.get_contacts():
            first, second = (self._links.get(body, WORLD) for body in contact.bodies)
            pairs.append(NearPair(first, second, min(point.separation for point in contact.points)))
        return pairs


@lru_cache(maxsize=8)
def scene_contacts(spec: SceneSpec) -> Contacts:
    """Return the contacts of the robot of ``spec``, the same object for equal specs."""
    return Contacts(spec)
