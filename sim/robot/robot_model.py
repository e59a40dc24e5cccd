"""Model of one robot at given poses: dynamics by :mod:`batchpid.task_space`, contacts from its
collision shapes, and the pairs of links that do not collide.

The rigid tree has the simulated bodies in double precision. SAPIEN's tree has single precision.

Pairs that do not collide come from an .srdf, or from the links' distances at sampled poses. MoveIt's
setup assistant finds the pairs that its planners leave out of collision checks in this way (D.
Coleman et al., "Reducing the barrier to entry of complex robotic software: a MoveIt! case study", J.
Softw. Eng. Robotics 5, 2014).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import combinations
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

import batchpid.task_space as ts
from batchpid.arrays.array_types import Array, Bool, Float64, Rows
from batchpid.motors.coupling import Coupling
from batchpid.sim.description.merging import body_tree, merge_links, rigid_bodies
from batchpid.sim.description.tables import DisabledPair, Tables
from batchpid.sim.geometry.distances import Contacts
from batchpid.task_space.frames import SpatialInertia, matrix_of, spatial_matrix
from batchpid.task_space.rigid_tree import RigidTree

if TYPE_CHECKING:
    from batchpid.sim.robot.robot import Robot

GRAVITY_MARGIN = 2.0
"""Suggested limit over the effort that holds the joint still."""
SPEED, ACCELERATION = 3.0, 30.0
"""Speed [rad/s or m/s] at which the joint's damping is overcome, and acceleration [rad/s^2 or m/s^2]
of all joints at once, of suggested limits.
"""
POSES = 50
TARGET_SHARES = (1.0, -1.0, 0.5, -0.5, 0.2, -0.2)
"""Shares of the first move that are tried for one without contact."""
ALWAYS = 0.95
"""Share of sampled poses beyond which a pair counts as always in contact; MoveIt's."""
GAP = 1e-3
"""Distance [m] that counts as contact: links built to glide along each other never come apart, and
PhysX pushes links apart that just touch at the start.
"""
SAMPLES = 200
"""Number of sampled poses; MoveIt's."""


@dataclass(frozen=True, eq=False)
class RobotModel:
    """Dynamics and contacts of a robot on a fixed base, at poses qpos (n, dof).

    Friction, damping and motors are left out. Several threads may use one object.
    """

    tree: RigidTree
    """Tree of the simulated links on a fixed base."""
    coupling: Coupling
    """Coupling of its joints."""
    tables: Tables
    """Simulated bodies."""
    ignored: frozenset[frozenset[str]]
    """Pairs of links that do not collide."""
    ground: bool
    """Whether there is a ground at height 0."""

    def __reduce__(self) -> Any:  # a controller that keeps it can be sent to worker processes
        return RobotModel, (self.tree, self.coupling, self.tables, self.ignored, self.ground)

    def mass_matrix(self, qpos: Array) -> Array:
        """Return the joint-space mass matrices (n, dof, dof) [kg m^2 or kg], in NumPy or JAX as
        ``qpos``.
        """
        return ts.mass_matrix(self.tree, qpos)

    def inverse_dynamics(self, qpos: Array, qvel: Array, qacc: Array) -> Array:
        """Return the efforts (n, dof) [N m or N] of a motion, gravity included; in NumPy or JAX as
        the arguments.
        """
        return ts.inverse_dynamics(self.tree, qpos, qvel, qacc)

    def holding_efforts(self, qpos: Rows) -> Float64:
        """Return the efforts (n, dof) [N m or N] that hold ``qpos`` against gravity; leaders hold
        followers.
        """
        still = np.zeros_like(qpos)
        efforts: Float64 = self.coupling.efforts(self.inverse_dynamics(qpos, still, still))
        return efforts

    def forward_dynamics(self, qpos: Array, qvel: Array, effort: Array) -> Array:
        """Return the accelerations (n, dof) [rad/s^2 or m/s^2] under ``effort`` [N m or N], gravity
        included.

        Followers move with their leaders. The result is in NumPy or JAX as the arguments.
        """
        return ts.forward_dynamics(self._coupled, qpos, qvel, effort)

    def standing_inertia(self, qpos: Rows) -> Float64:
        """Return the inertia (dof,) that each joint moves at one pose (dof,) if the base floats and
        its feet stand.

        The feet F are pinned. Velocities q' of the joints move the base at V = A q', A = -J_b^+
        J_j, where J_b and J_j are the Jacobians of F with respect to the base and the joints. The
        mass matrix of this motion is the sum of J^T I J of all bodies, with J = J_j + A for twists
        and inertias at the origin of the world. The result is the sum of the absolute values in
        each of its rows: diagonal gains for these sums are at least as stiff as gains for the
        matrix (Gershgorin's theorem).
        """
        tree = self.tree
        joints = np.asarray(qpos, np.float64)
        poses = ts.link_poses(tree, joints, tree.links)

        def jacobian(at: int) -> Float64:
            """Return the Jacobian (6, dof) of the point of a link at the origin of the world."""
            origin = -matrix_of(poses[at, 3:]).T @ poses[at, :3]
            return np.asarray(ts.jacobian(tree, joints, tree.links[at], point=origin))

        of_base, of_joints = [], []
        for link, (x, y, z) in self.contacts.feet(joints):
            # A twist of the base moves each point p of the world by v + w x p.
            point = np.hstack([np.eye(3), [[0, z, -y], [-z, 0, x], [y, -x, 0]]])
            of_base.append(point)
            of_joints.append(point @ jacobian(tree.index(link)))
        follow = np.zeros((6, tree.dof))
        if of_base:
            # Directions that the feet leave free are cut off, not followed.
            pinned = np.linalg.pinv(np.concatenate(of_base), rcond=1e-3)
            follow = -pinned @ np.concatenate(of_joints)
        matrix = np.zeros((tree.dof, tree.dof))
        for at, pose in enumerate(poses):
            body = SpatialInertia(tree.mass[at], tree.center[at], tree.inertia[at])
            moving = jacobian(at) + follow
            matrix += moving.T @ spatial_matrix(body.moved(pose[:3], pose[3:])) @ moving
        inertia: Float64 = np.abs(matrix).sum(1)
        return inertia

    @cached_property
    def _coupled(self) -> RigidTree:
        return replace(self.tree, coupling=self.coupling)

    @cached_property
    def contacts(self) -> Contacts:
        """Distances of the links to each other and to the ground."""
        return Contacts(self.tree, self.tables.shapes, self.ignored, self.ground)

    def in_contact(self, qpos: Rows, clearance: float = 0.0) -> Bool:
        """Return whether links are closer than ``clearance`` [m] to each other or to the ground
        (n,).

        Links that a fixed joint connects may touch, and the base and the links fixed to it may
        touch the ground.
        """
        return self.contacts.in_contact(qpos, clearance)


@lru_cache(maxsize=8)
def model_of(robot: Robot, ground: bool) -> RobotModel:
    """Return the model of a robot, with or without a ground."""
    ignored = frozenset(map(frozenset, robot.self_contact.ignored))
    # Merged, since the engines simulate merged links, too.
    simulated = merge_links(robot.tables)
    return RobotModel(body_tree(simulated), robot.coupling, simulated, ignored, ground)


@lru_cache(maxsize=8)
def link_tree(robot: Robot) -> RigidTree:
    """Return the tree of every link of the file, merged ones included, with the coupling and limits
    of the joints.

    Raises RobotError if a link's mass comes from its shapes, and a mesh cannot be read.
    """
    limits = np.where(robot.continuous, [[-np.inf], [np.inf]], [robot.lower, robot.upper])
    tree = body_tree(robot.tables, robot.fixed_base)
    return replace(
        tree,
        coupling=robot.coupling,
        lower=limits[0],
        upper=limits[1],
    )


def suggested_effort_limit(robot: Robot) -> Float64:
    """Return an effort limit for each joint (dof,) [N m or N], from gravity and M at POSES poses.

    It is 2 (max |g_j| + friction) + damping * 3 rad/s + max sum_k |M_jk| * 30 rad/s^2: twice the
    effort that holds the joint still, plus the effort that accelerates all joints at once, in the
    worst directions.
    """
    qpos = robot.sample(POSES)
    model = robot.dynamics()
    still = np.abs(model.holding_efforts(qpos)).max(0) + robot.friction
    inertia = np.abs(robot.coupling.mass_matrix(model.mass_matrix(qpos))).sum(2).max(0)
    efforts: Float64 = GRAVITY_MARGIN * still + SPEED * robot.damping + ACCELERATION * inertia
    return efforts


@lru_cache(maxsize=8)
def free_target(robot: Robot) -> Float64:
    """Return the pose (dof,) for a first move of a robot without settings;
    :attr:`batchpid.sim.Robot.target` describes it.
    """
    start = robot.start
    # Toward the farther limit, so that the move is inside.
    above = robot.upper - start
    below = robot.lower - start
    move = np.clip(0.25 * np.where(above >= -below, above, below), -0.5, 0.5)
    model = robot.dynamics(ground=robot.fixed_base and robot.has_ground)
    for share in TARGET_SHARES:
        ways = share * np.linspace(0.2, 1.0, 5)[:, None] * move
        poses = robot.coupling.positions(np.clip(start + ways, robot.lower, robot.upper))
        if not model.in_contact(poses).any():
            target: Float64 = poses[-1]
            return target
    # Links touch at the start already, which is a finding.
    touching: Float64 = robot.coupling.positions(start + move)
    return touching


def base_start(robot: Robot, qpos: Float64, ground: bool) -> Float64:
    """Return the pose (7,) from which a floating base starts with its joints at ``qpos`` (dof,).

    It is the file's, with the lowest point of the robot as high as at the start pose of the joints.
    If the file does not place the base, it is upright at the origin. On a ``ground`` at height 0
    the lowest point is then on the ground, and otherwise not below.
    """
    pose = np.array(robot.source.base_start or (0, 0, 0, 1, 0, 0, 0), np.float64)
    model = robot.dynamics()
    # The ground is met by any link, the base included.
    height = model.contacts.height(np.nan_to_num(qpos), base_too=True)
    if not np.isfinite(height):
        return pose
    if robot.source.base_start is not None:
        lowest = pose[2] + model.contacts.height(robot.start, base_too=True)
        pose[2] = (max(lowest, 0.0) if ground else lowest) - height
    elif ground:
        pose[2] = -height
    return pose


class SelfContact(NamedTuple):
    """Contact of a robot's links with each other and with the ground.

    ``pairs`` do not collide. ``reaches_ground`` is True if a link other than the base touches the
    ground at the start pose.
    """

    pairs: tuple[DisabledPair, ...]
    reaches_ground: bool

    @property
    def ignored(self) -> tuple[tuple[str, str], ...]:
        """Names of the links of the pairs."""
        return tuple((pair.first, pair.second) for pair in self.pairs)


def self_contact(robot: Robot) -> SelfContact:
    """Return the pairs of links of a robot that do not collide, under its option ``self_collision``
    and its .srdf.

    Deterministic: the poses are seeded. Raises RobotError for a mesh that cannot be read.
    """
    source = robot.source
    solid = list(dict.fromkeys(shape.owner for shape in robot.tables.shapes))
    simulated = merge_links(robot.tables)
    tree = body_tree(simulated, robot.fixed_base)
    contacts = Contacts(tree, simulated.shapes, frozenset(), ground=False)
    computed: Iterable[DisabledPair] = ()
    if source.self_collision == "none":
        computed = (DisabledPair(*pair, "User") for pair in combinations(solid, 2))
    elif source.self_collision == "auto":
        computed = _touching_pairs(robot, contacts, solid)
    # The .srdf comes last, so that its reason holds.
    pairs = {pair.links: pair for pair in (*computed, *source.disabled)}
    listed = (pairs[links] for links in pairs if links <= set(solid))
    return SelfContact(
        pairs=tuple(pair for pair in listed if pair.links not in source.enabled),
        reaches_ground=robot.fixed_base and contacts.height(robot.start) < GAP,
    )


def _touching_pairs(
    robot: Robot, contacts: Contacts, solid: Sequence[str]
) -> Iterator[DisabledPair]:
    """Yield the pairs of the links with shapes, ``solid``, that touch by design, with the first of
    their reasons.

    Neighbours are links whose rigid bodies are connected by a joint, or by a chain of joints and
    bodies without shapes.
    """
    joints = robot.tables.joints
    bodies = rigid_bodies(joints)
    shaped = {bodies[link] for link in solid}
    if len(shaped) < 2:
        return
    parents = {joint.child_link: bodies[joint.parent_link] for joint in joints if joint.moves}
    above: dict[str, str | None] = {}
    for link in solid:
        body = parents.get(bodies[link])
        while body is not None and body not in shaped:
            body = parents.get(body)
        above[link] = body
    # The first pose is the start; the others judge how often a pair touches.
    rest, *samples = [
        {frozenset(near[:2]) for near in contacts.near(qpos, GAP)}
        for qpos in (robot.start, *robot.sample(SAMPLES, seed=0))
    ]
    touches = Counter(pair for sample in samples for pair in sample)
    for first, second in combinations(solid, 2):
        pair = frozenset((first, second))
        if above[first] == bodies[second] or above[second] == bodies[first]:
            yield DisabledPair(first, second, "Adjacent")
        elif pair in rest:
            yield DisabledPair(first, second, "Default")
        elif touches[pair] > ALWAYS * len(samples):
            yield DisabledPair(first, second, "Always")
