"""Rigid trees and contacts of the robot of a scene, and the efforts that hold it against
gravity.
"""

from __future__ import annotations

import numpy as np

import batchpid.task_space as ts
from batchpid.arrays.array_types import Float64
from batchpid.sim.engine.scene_spec import SceneSpec
from batchpid.sim.robot.contacts import Contacts
from batchpid.task_space.rigid_tree import RigidTree


def passive_force(
    tree: RigidTree,
    qpos: Float64,
    qvel: Float64,
    gravity: bool,
    coriolis: bool,
    base: Float64 | None = None,
) -> Float64:
    """Return the gravity part of :func:`batchpid.task_space.bias` (n, dof), its velocity part, or
    both.

    ``base`` (n, 6) are gravity and the rate at which the base turns, in its own axes, of one that
    floats, or with a tree on a fixed base of one that is held where it is. The gravity part of a
    floating base is 0.
    """
    zero = np.zeros_like(np.asarray(qpos, np.float64))
    turning = None
    bodies = None
    if base is not None:
        turning = base[:, 3:]
        bodies = tree.bodies._replace(gravity=base[:, None, :3])
    force = zero
    if coriolis or gravity:
        force = ts.bias(
            tree, qpos, qvel if coriolis else zero, turning if coriolis else None, bodies=bodies
        )
    if coriolis and not gravity:
        force = force - ts.bias(tree, qpos, zero, bodies=bodies)
    return np.asarray(force, np.float64)


def contacts_of(spec: SceneSpec, ground: bool) -> Contacts:
    """Return the contacts of the robot of ``spec``, even of one without shapes there; ``ground`` is
    at height 0.
    """
    ignored = {frozenset(pair) for pair in spec.ignored}
    return Contacts(spec.rigid_tree, spec.simulated.shapes, ignored, ground)
