"""Watch over the contacts of robots that share PhysX systems: which of them have to move to a system to themselves.

A robot is looked at where the engine lists pairs of its links and it has no region in which no contact can be
predicted, or has left that region (:mod:`batchpid.sim.engine.sapien.contact_prediction`). When a robot is looked at
depends on it alone, and not on the others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Float64
from batchpid.sim.engine.sapien.contact_prediction import WORLD, ContactPredictor, NearPair, SafeRegions
from batchpid.sim.engine.sapien.dynamics import Dynamics, scene_dynamics
from batchpid.sim.engine.sapien.extents import link_extents, touching_pairs
from batchpid.sim.engine.scene_spec import SceneSpec

RETRY_LOOKS = 50
"""Looks at a robot after one that found no region, as it moves too fast, until a region is tried again."""


class ContactWatch:
    """Watch over ``size`` robots of ``spec``, of which ``robot`` is one of SAPIEN's."""

    def __init__(self, spec: SceneSpec, robot: Any, size: int) -> None:
        self._spec = spec
        self._predictor = ContactPredictor(
            link_extents(robot), touching_pairs(robot, spec.ground), robot.dof, spec.timestep
        )
        self._regions = SafeRegions(size, self._predictor.arms)
        self._waits = np.zeros(size, int)  # looks until a region is tried again
        self._sharing: dict[int, Any] = {}

    @property
    def regions(self) -> SafeRegions:
        """Regions of the robots, in which no contact is predicted."""
        return self._regions

    @property
    def systems(self) -> list[Any]:
        """Systems to look at in every sim step: those with a robot that has no region. Replaced, never changed."""
        return self._systems

    @property
    def links(self) -> dict[Any, tuple[int, int]]:
        """Robot and number of each link that is watched."""
        return self._links

    def bind(self, robots: Sequence[Any], systems: Sequence[Any], rows: Iterable[int]) -> None:
        """Watch the robots ``rows``, those that share systems and may touch, and no others."""
        self._robots, self._sharing = robots, {row: systems[row] for row in rows}
        self._links = {link: (row, i) for row in self._sharing for i, link in enumerate(robots[row].links)}
        self._choose_systems()

    @cached_property
    def _model(self) -> Dynamics:
        return scene_dynamics(self._spec)

    def _choose_systems(self) -> None:
        """Choose the systems to look at in every sim step: those with a robot that has no region."""
        known = self._regions.known
        self._systems = list(dict.fromkeys(system for row, system in self._sharing.items() if not known[row]))

    def place(self, rows: Sequence[int], qpos: NDArray[Any], qvel: NDArray[Any]) -> list[bool]:
        """Return for each robot of ``rows`` whether contact is predicted, after it was placed there (rows, dof)."""
        self._regions.drop(list(rows))
        self._waits[list(rows)] = 0
        found = dict[bytes, tuple[bool, Float64 | None]]()
        predicted = []
        for row, position, velocity in zip(rows, qpos, qvel, strict=True):
            state = position.tobytes() + velocity.tobytes()
            if state not in found:
                found[state] = self._judge(self._model.near_pairs(position), position, velocity)
            touches, bounds = found[state]
            predicted.append(touches)
            if bounds is not None:
                self._regions.enter(row, position, bounds)
        self._choose_systems()
        return predicted

    def step(self, read_qpos: Callable[[], Float64]) -> tuple[list[int], Float64 | None]:
        """Return the robots for which contact is predicted after a sim step, and the positions if they were needed."""
        qpos, left = None, list[int]()
        if self._regions.any:
            qpos = read_qpos()
            left = self._regions.left(qpos)
        return self.look(left), qpos

    def look(self, left: list[int]) -> list[int]:
        """Return the robots for which contact is predicted, the robots ``left`` having left their regions."""
        if left:
            self._regions.drop(left)
            left = [row for row in left if row in self._sharing]
        systems = self._systems
        if left:
            systems = list(dict.fromkeys([*systems, *(self._sharing[row] for row in left)]))
        near: dict[int, list[NearPair]] = {row: [] for row in left}
        for system in systems:
            if contacts := system.get_contacts():
                self._add_near_pairs(contacts, near)
        return self._look(near) if near else []

    def _add_near_pairs(self, contacts: Iterable[Any], near: dict[int, list[NearPair]]) -> None:
        """Add to ``near`` the pairs in a system's contacts, for robots without a region."""
        for contact in contacts:
            (row, first), (other, second) = (self._links.get(body, (None, WORLD)) for body in contact.bodies)
            row = other if row is None else row
            if row is not None and not self._regions.known[row]:
                distance = min([point.separation for point in contact.points])
                near.setdefault(row, []).append(NearPair(first, second, distance))

    def _look(self, near: dict[int, list[NearPair]]) -> list[int]:
        """Return the robots for which their pairs predict contact; give the others with pairs a region."""
        predicted = []
        for row, pairs in near.items():
            qpos = self._robots[row].get_qpos()
            self._waits[row] -= self._waits[row] > 0
            touches, bounds = self._judge(pairs, qpos, self._robots[row].get_qvel(), not self._waits[row])
            if touches:
                predicted.append(row)
            if bounds is not None:
                self._regions.enter(row, qpos, bounds)
            elif pairs and not self._waits[row]:
                self._waits[row] = RETRY_LOOKS
        self._choose_systems()
        return predicted

    def _judge(
        self, pairs: list[NearPair], qpos: NDArray[Any], qvel: NDArray[Any], settles: bool = True
    ) -> tuple[bool, Float64 | None]:
        """Return whether contact is predicted, and the bounds of a region if it has one and ``settles``."""
        touches = self._predictor.predicts_contact(pairs, qvel)
        if touches or not pairs or not settles:
            return touches, None
        return False, self._predictor.region(pairs, qvel, lambda: self._model.link_poses(qpos))
