"""Sensors of links in SAPIEN: contact forces, and wrenches between a link and its parent.

PhysX reports the normal forces of contacts, but not their friction. So the net contact force F on a
body of mass m is computed from the velocity v of its center of mass, gravity g, and the forces in
its joints, which PhysX reports::

    F = m (dv/dt - g) - (force of the parent on it) + (its forces on its children)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from sapien.physx import PhysxArticulation, PhysxCpuSystem

from batchpid.arrays.array_types import Float32, Float64
from batchpid.sim.engine.scene_spec import SceneSpec


class SapienLinkSensors:
    """Sums of the sensors of ``spec`` over sim steps. ``robots`` and ``systems`` are a pack's own
    lists.
    """

    def __init__(
        self, spec: SceneSpec, robots: list[PhysxArticulation], systems: list[PhysxCpuSystem]
    ) -> None:
        self._robots = robots
        self._systems = systems
        self._spec = spec
        links = [link.name for link in robots[0].links]
        bodies = spec.simulated.links
        self._contacts = [links.index(bodies[link].link) for link in spec.contacts or ()]
        self._wrenches = [links.index(link) for link in spec.wrenches or ()]
        parents = [
            None if joint.parent_link is None else joint.parent_link.name
            for joint in robots[0].joints
        ]
        self._children = {
            at: [i for i, name in enumerate(parents) if name == links[at]] for at in self._contacts
        }
        self._roots = {at for at, name in enumerate(parents) if name is None}
        self._velocities = np.zeros((len(robots), len(self._contacts), 3))
        # Links, joints, numbers of the links by entity, and gravity of each robot.
        self._parts: list[Any] = [None] * len(robots)
        self._sums: dict[str, Float64] = {}
        self.take()
        self.place(range(len(robots)))

    def take(self) -> dict[str, Float64]:
        """Return the sums since the last call, and set them to 0."""
        before = self._sums
        (size, contacts, _) = self._velocities.shape
        shapes = {
            "contact_force": (contacts, 3),
            "touching": (contacts,),
            "wrench": (len(self._wrenches), 6),
        }
        self._sums = {name: np.zeros((size, *shape)) for name, shape in shapes.items() if shape[0]}
        return before

    def place(self, rows: Sequence[int]) -> None:
        """Set the sums of robots ``rows`` to 0, after they were placed."""
        for row in rows:
            robot = self._robots[row]
            numbers = {link.entity: at for at, link in enumerate(robot.links)}
            self._parts[row] = robot.links, robot.joints, numbers, self._systems[row].config.gravity
            self._velocities[row] = self._read_velocities(row)
            for sums in self._sums.values():
                sums[row] = 0.0

    def _read_velocities(self, row: int) -> Float64:
        links, *_ = self._parts[row]
        return np.array(
            [links[at].get_linear_velocity() for at in self._contacts], np.float64
        ).reshape(-1, 3)

    def add(self) -> None:
        """Add the sensors of all robots after a sim step."""
        for row in range(len(self._robots)):
            self._add(row)

    def _add(self, row: int) -> None:
        links, joints, _, gravity = self._parts[row]
        forces = self._robots[row].get_link_incoming_joint_forces()
        # The force of the joint is the wrench; it needs no difference of velocities.
        if self._wrenches:
            self._sums["wrench"][row] += [_in_link(joints[at], forces[at]) for at in self._wrenches]
        if not self._contacts:
            return
        velocities = self._read_velocities(row)
        touched = self._touched(row)
        for number, at in enumerate(self._contacts):
            if at not in touched:
                continue
            rate = (velocities[number] - self._velocities[row, number]) / self._spec.timestep
            force = links[at].mass * (rate - gravity)
            if at not in self._roots:
                # What the joints transmit is not contact: of the parent on the link, and of it on its children.
                force -= _in_world(links[at], joints[at], forces[at])
            for child in self._children[at]:
                force += _in_world(links[child], joints[child], forces[child])
            self._sums["contact_force"][row, number] += force
            self._sums["touching"][row, number] += 1.0
        self._velocities[row] = velocities

    def _touched(self, row: int) -> set[int]:
        """Return the links with a contact of nonzero impulse."""
        _, _, numbers, _ = self._parts[row]
        return {
            numbers[body.entity]
            for contact in self._systems[row].get_contacts()
            if any(point.impulse.any() for point in contact.points)
            for body in contact.bodies
            if body.entity in numbers
        }


def _in_link(joint: Any, force: Float32) -> Float64:
    """Transform a force and torque (6,) from the frame of a joint to the frame of its link, about
    the link's origin.
    """
    placed = joint.pose_in_child.to_transformation_matrix().astype(np.float64)
    axes = placed[:3, :3]
    linear = placed[:3, :3] @ force[:3]
    return np.concatenate([linear, axes @ force[3:] + np.cross(placed[:3, 3], linear)])


def _in_world(link: Any, joint: Any, force: Float32) -> Float64:
    """Return the force (6,) of a joint's parent on its link along the axes of the world, without
    the torque.
    """
    axes = (link.entity_pose * joint.pose_in_child).to_transformation_matrix()[:3, :3]
    forces: Float64 = axes.astype(np.float64) @ force[:3]
    return forces
