r"""Robot in a compiled MJCF file: its bodies, joints and collision shapes as tables.

The bodies and joints of the model get the names of the links and joints that they become.

A hinge with anchor p, axis a and reference angle q0 moves its body by Trans(p) Rot(a, q - q0)
Trans(-p), so that the row of the tables, whose origin is the anchor, is at::

    origin = X Trans(p) Rot(a, -q0)        row = origin Rot(a, q)        body = row Trans(-p)

with X the pose of the body before this joint, in the row above; a slide moves by Trans(a (q -
q0)), with p = 0. Several joints of one body become a chain of rows, of which the last has the mass.
(MuJoCo's documentation, "Computation", kinematic tree.)

A mesh collides as its convex hull, in MuJoCo and in PhysX, and an ellipsoid as a polyhedron.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from batchpid.arrays.array_types import Bool, Float64, MjModel
from batchpid.errors import RobotError
from batchpid.sim.description.tables import (
    NO_TURN,
    ORIGIN,
    Body,
    DisabledPair,
    Joint,
    Mimic,
    Tables,
    breadth_first,
    unique,
    with_mass,
    without_mass,
)
from batchpid.sim.findings import Finding
from batchpid.sim.geometry.shapes import Shape, ShapeKind, hull_graph
from batchpid.task_space.frames import about, compose, matrix_of, rotate

if TYPE_CHECKING:
    from batchpid.sim.description.mjcf_motors import Couplings, JointMotors

PLANE = mujoco.mjtGeom.mjGEOM_PLANE
_FREE, _BALL = mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL
_SLIDE, _HINGE = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
_SHAPE_KINDS: dict[int, tuple[ShapeKind, int]] = {
    mujoco.mjtGeom.mjGEOM_SPHERE: ("sphere", 1),
    mujoco.mjtGeom.mjGEOM_BOX: ("box", 3),
    mujoco.mjtGeom.mjGEOM_CAPSULE: ("capsule", 2),
    mujoco.mjtGeom.mjGEOM_CYLINDER: ("cylinder", 2),
}
"""Kind of a shape, and the number of its sizes, by type of a geom."""
_POINTS = 160
"""Vertices of an ellipsoid's hull."""


def label(element: Any) -> str:
    """Return the quoted name of an element of a model, or its number if it has none."""
    return repr(element.name or f"number {element.id}")


def can_collide(model: MjModel) -> Bool:
    """Return whether each geom (geoms,) collides with anything, by its masks or in a ``<pair>``."""
    paired = [*model.pair_geom1, *model.pair_geom2]
    collides: Bool = (model.geom_contype | model.geom_conaffinity) != 0
    collides[paired] = True
    return collides


class RobotInFile:
    """Robot of a compiled file: names of its parts, by their numbers in the model.

    ``bodies`` has all bodies of the file, ``joints`` the hinges and slides of the robot, ``base``
    is the body of the root, 0 for the world; ``link_names`` and ``joint_names`` are all names in
    use. ``moments`` are the moment arms of the outputs of actuators on the degrees of freedom, at
    the reference pose. ``repairs`` are findings of what is simulated otherwise than the file says.
    After :meth:`read` ``solid`` is the name of the row of each body that has shapes, by
    the body's number.

    Raises RobotError for a ball joint, and for several robots.
    """

    def __init__(self, model: MjModel, path: Path, repairs: list[Finding]) -> None:
        self.model = model
        self.repairs = repairs
        names = [model.body(body).name for body in range(1, model.nbody)]
        self.link_names = {"world", *names}
        self.joint_names = {model.joint(joint).name for joint in range(model.njnt)}
        self.bodies = {0: "world"}
        for body, name in enumerate(names, start=1):
            self.bodies[body] = name or unique(f"body{body}", self.link_names)
        self._roots = model.body_rootid
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        self.moments = np.zeros((len(data.moment_rownnz), model.nv))
        sparse = data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind
        mujoco.mju_sparse2dense(self.moments, *sparse)
        self.left_out: set[int] = set()
        self._anchors = {0: ORIGIN}  # origin of each body's row, in the frame of the body
        self._bodies: list[Body] = []
        self._shapes: list[Shape] = []
        self.solid: dict[int, str] = {}
        self.base = self._find_base(path)
        self.joints = {}
        for joint in np.flatnonzero(np.isin(model.jnt_type, [_SLIDE, _HINGE])).tolist():
            name = model.joint(joint).name or unique(f"joint{joint}", self.joint_names)
            if self.is_of_robot(model.jnt_bodyid[joint]):
                self.joints[joint] = name

    def is_of_robot(self, body: int) -> bool:
        """Return whether a body, or the world, is of the robot."""
        return int(self._roots[body]) not in self.left_out

    def _find_base(self, path: Path) -> int:
        """Return the base, after the bodies that are not of the robot are left out.

        The robot is the object on a free joint that has joints of its own, where actuators move
        it or move nothing that has joints; else all objects that are not on a free joint.
        """
        model = self.model
        # Every child of the world is the root of an object.
        tops = {body for body in range(1, model.nbody) if model.body_parentid[body] == 0}
        roots = model.body_rootid
        free, balls, moving = (
            set(roots[model.jnt_bodyid[np.isin(model.jnt_type, kinds)]].tolist())
            for kinds in ([_FREE], [_BALL], [_SLIDE, _HINGE])
        )
        # A flexible body has three slides for each vertex.
        soft = {int(body) for body in model.flex_vertbodyid if not model.body_geomnum[body]} & tops
        moving -= soft
        driven = moving & set(roots[model.dof_bodyid[self.moments.any(0)]].tolist())
        floating = moving & free & (driven or moving)
        if len(floating) > 1 or (floating and moving - free):
            listed = ", ".join(repr(self.bodies[body]) for body in sorted(floating | moving - free))
            raise RobotError(
                f"{path}: holds several robots, {listed}; leave one of them in the file"
            )
        # A robot on a free joint is one object; all others are scenery.
        if floating:
            self.left_out = tops - floating
        else:
            mocaps = {body for body in tops if model.body_mocapid[body] >= 0}
            self.left_out = mocaps | soft | free | (balls - moving)
        for joint in np.flatnonzero(model.jnt_type == _BALL).tolist():
            body = int(model.jnt_bodyid[joint])
            if self.is_of_robot(body):
                where = f"{path}: body {self.bodies[body]!r}"
                problem = f"the ball joint {label(model.joint(joint))} has no single position"
                raise RobotError(f"{where}: {problem} to control; replace it by three hinges")
        return floating.pop() if floating else 0

    def read(self, couplings: Couplings, motors: JointMotors, is_held: bool) -> Tables:
        """Return the tables; ``is_held`` says whether a base on a free joint is fixed."""
        model = self.model
        read_joint = partial(self._read_joint, couplings, motors)
        root = None
        if self.base == 0:
            self._add(0, Body(self.bodies[0], None), ORIGIN)
        # A free joint that is held keeps its turn: a row above the base has it.
        elif is_held and model.body_quat[self.base][0] != 1:
            root = unique(f"{self.bodies[self.base]}_frame", self.link_names)
            self._bodies.append(Body(root, None))
        rows = {self.base}
        for body in range(1, model.nbody):
            above = int(model.body_parentid[body])
            if body == self.base:
                self._read_body(body, root, read_joint)
            elif above in rows and self.is_of_robot(body):
                self._read_body(body, self.bodies[above], read_joint)
                rows.add(body)
        return breadth_first(self._bodies, self._shapes)

    def _read_body(
        self, body: int, parent: str | None, read_joint: Callable[[int, str, str], Joint]
    ) -> None:
        """Read a body, and the joints between it and the row ``parent``; None for the root."""
        model = self.model
        name = self.bodies[body]
        joints = [joint for joint in self.joints if model.jnt_bodyid[joint] == body]
        place = model.body_pos[body] - self._anchors[int(model.body_parentid[body])]
        turn = model.body_quat[body].copy()
        anchor = ORIGIN
        if model.body_jntnum[body] > len(joints):  # on a free joint, which has the position
            place = ORIGIN
        row = Body(name, None)
        if parent is not None and not joints:
            fixed = unique(f"{name}_fixed", self.joint_names)
            row = Body(name, Joint(fixed, "fixed", parent, name), place, turn)
        for number in joints:
            axis = model.jnt_axis[number]
            rest = model.qpos0[model.jnt_qposadr[number]]
            if model.jnt_type[number] == _SLIDE:
                anchor = ORIGIN
                place = place - rest * rotate(matrix_of(turn), axis)
            else:
                anchor = model.jnt_pos[number]
                place = place + rotate(matrix_of(turn), anchor)
                turn = compose(turn, about(axis, np.asarray(-rest)))
            link = name
            if number != joints[-1]:
                link = unique(f"{name}_{self.joints[number]}", self.link_names)
            row = Body(link, read_joint(number, str(parent), link), place, turn)
            if number != joints[-1]:
                self._bodies.append(row)
            # The next joint of the body begins where this one ends.
            parent = link
            place = -anchor
            turn = NO_TURN
        self._add(body, row, anchor)

    def _read_joint(
        self,
        couplings: Couplings,
        motors: JointMotors,
        number: int,
        parent: str,
        link: str,
    ) -> Joint:
        model = self.model
        name = self.joints[number]
        dof = model.jnt_dofadr[number]
        lower, upper = -np.inf, np.inf
        if model.jnt_limited[number]:
            lower, upper = model.jnt_range[number].tolist()
        if model.jnt_type[number] == _SLIDE:
            kind = "prismatic"
        elif model.jnt_limited[number]:
            kind = "revolute"
        else:
            kind = "continuous"
        soft_lower, soft_upper = motors.setpoints[:, number].tolist()
        if soft_lower > lower or soft_upper < upper:
            text = "its servo in the file limits the setpoint"
            remedy = "pass guard=True to a runner for these limits"
            detail = f"{soft_lower:g} to {soft_upper:g}"
            self.repairs.append(Finding("limits", text, remedy, name, detail=detail))
        mimic = None
        if number in couplings:
            leader, *law = couplings[number]
            mimic = Mimic(self.joints[leader], *law)
        return Joint(
            name,
            kind,
            parent,
            link,
            lower,
            upper,
            effort_limit=float(motors.effort_limit[number]),
            soft_lower=soft_lower,
            soft_upper=soft_upper,
            damping=float(model.dof_damping[dof]),
            friction=float(model.dof_frictionloss[dof]),
            mimic=mimic,
            axis=tuple(model.jnt_axis[number].tolist()),
            has_motor=not motors.unmoved[number],
        )

    def _add(self, body: int, row: Body, anchor: Float64) -> None:
        """Add a row with inertia and shapes of a body, in a frame with its origin at ``anchor``."""
        model = self.model
        self._anchors[body] = anchor
        for geom in np.flatnonzero(can_collide(model) & (model.geom_bodyid == body)).tolist():
            if (shape := self._read_shape(geom, row.name, anchor)) is not None:
                self._shapes.append(shape)
                self.solid[body] = row.name
        mass = float(model.body_mass[body])
        # Else the row would get the mass of its shapes.
        if mass == 0 and body in self.solid:
            row = without_mass(row)
        if mass > 0:
            center = model.body_ipos[body] - anchor
            inertia = np.diag(model.body_inertia[body])
            turn = model.body_iquat[body].copy()
            row = with_mass(row, mass, center, inertia, turn, self.repairs)
        self._bodies.append(row)

    def _read_shape(self, geom: int, link: str, anchor: Float64) -> Shape | None:
        """Return the shape of a geom of ``link``, None for a plane or a height field."""
        model = self.model
        shape_type = int(model.geom_type[geom])
        place = model.geom_pos[geom] - anchor
        turn = model.geom_quat[geom].copy()
        if shape_type in _SHAPE_KINDS:
            kind, count = _SHAPE_KINDS[shape_type]
            size = tuple(model.geom_size[geom, :count].tolist())
            return Shape(
                link,
                link,
                kind,
                size,
                place,
                turn,
            )
        if shape_type == mujoco.mjtGeom.mjGEOM_ELLIPSOID:  # which PhysX does not have
            vertices = _ellipsoid(model.geom_size[geom])
        elif shape_type in (mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_SDF):
            vertices = _hull(model, int(model.geom_dataid[geom]))
        else:
            return None
        return Shape(
            link,
            link,
            "mesh",
            (),
            place,
            turn,
            vertices=vertices,
        )


def excluded_pairs(model: MjModel, solid: dict[int, str]) -> tuple[DisabledPair, ...]:
    """Return the pairs of rows with shapes that never collide: excluded, or by the masks of all
    their geoms.

    ``solid`` maps bodies with shapes to their rows. Bodies that are welded together do not count.
    """
    excluded = {
        frozenset((int(pair) >> 16, int(pair) & 0xFFFF)) for pair in model.exclude_signature
    }
    paired = {
        frozenset(model.geom_bodyid[[one, other]].tolist())
        for one, other in zip(model.pair_geom1, model.pair_geom2, strict=True)
    }
    types, affinities = model.body_contype, model.body_conaffinity
    pairs = []
    for first, second in combinations(solid, 2):
        pair = frozenset((first, second))
        meet = types[first] & affinities[second] | types[second] & affinities[first]
        is_apart = model.body_weldid[first] != model.body_weldid[second]
        if is_apart and pair not in paired and (pair in excluded or not meet):
            pairs.append(DisabledPair(solid[first], solid[second], "User"))
    return tuple(pairs)


def _hull(model: MjModel, mesh: int) -> Float64:
    """Return the vertices (n, 3) [m] of the convex hull of a mesh, or of the mesh if it has none."""
    first = int(model.mesh_vertadr[mesh])
    count = int(model.mesh_vertnum[mesh])
    vertices: Float64 = model.mesh_vert[first : first + count].astype(np.float64)
    if model.mesh_graphadr[mesh] >= 0:
        vertices = vertices[np.sort(hull_graph(model, mesh)[0])]
    return vertices


def _ellipsoid(radii: Float64) -> Float64:
    """Return points (n, 3) on an ellipsoid, along a spiral from pole to pole that turns by the
    golden angle (A. Gonzalez, "Measurement of areas on a sphere using Fibonacci and
    latitude-longitude lattices", Math. Geosci. 42, 2010).
    """
    height = np.linspace(-1, 1, _POINTS)
    angle = np.arange(_POINTS) * np.pi * (3 - np.sqrt(5))
    radius = np.sqrt(1 - height**2)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], -1) * radii
