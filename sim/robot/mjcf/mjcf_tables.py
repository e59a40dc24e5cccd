r"""Bodies, joints and collision shapes of a compiled MJCF file, as the tables of a robot.

A hinge with anchor p, axis a and reference angle q0 moves its body by Trans(p) Rot(a, q - q0)
Trans(-p), so that the row of the tables, whose origin is the anchor, is at::

    origin = X Trans(p) Rot(a, -q0)        row = origin Rot(a, q)        body = row Trans(-p)

with X the pose of the body before this joint, in the row above; a slide moves by Trans(a (q -
q0)), with p = 0. Several joints of one body become a chain of rows, of which the last has the mass.
(MuJoCo's documentation, "Computation", kinematic tree.)

A mesh collides as its convex hull, in MuJoCo and in PhysX.
"""

from __future__ import annotations

from collections import defaultdict
from itertools import combinations
from pathlib import Path

import mujoco
import numpy as np

from batchpid.arrays.array_types import Float64, MjModel
from batchpid.errors import RobotError
from batchpid.sim.robot.findings import Finding
from batchpid.sim.robot.link_repair import possible_inertia
from batchpid.sim.robot.mjcf.mjcf_actuators import Couplings, Motors
from batchpid.sim.robot.mjcf.mjcf_compiler import ALONE, Names, label
from batchpid.sim.robot.parts import Joint, Mimic
from batchpid.sim.robot.self_collision import DisabledPair
from batchpid.sim.robot.tables import NO_TURN, ORIGIN, Body, Shape, ShapeKind, Tables, breadth_first
from batchpid.task_space.frames import about, compose, matrix_of, rotate

NO_MASS = 1e-9
"""Mass [kg] of a body with shapes and without mass: a row without mass gets that of its shapes."""
PLANE = mujoco.mjtGeom.mjGEOM_PLANE
_KINDS: dict[mujoco.mjtGeom, tuple[ShapeKind, int]] = {
    mujoco.mjtGeom.mjGEOM_SPHERE: ("sphere", 1),
    mujoco.mjtGeom.mjGEOM_BOX: ("box", 3),
    mujoco.mjtGeom.mjGEOM_CAPSULE: ("capsule", 2),
    mujoco.mjtGeom.mjGEOM_CYLINDER: ("cylinder", 2),
}
"""Kind of a shape, and the number of its sizes, by type of a geom."""
_PARALLELS, _MERIDIANS = 12, 16
"""Rings, poles included, and vertices of a ring, of an ellipsoid's hull."""


def find_base(model: MjModel, names: Names, path: Path, findings: list[Finding]) -> int:
    """Return the body of the root, 0 for the world, and remove other objects from ``names``.

    Raises RobotError if there is a ball joint, or more than one robot.
    """
    tops = {body for body in range(1, model.nbody) if model.body_parentid[body] == 0}
    free, balls = (
        {int(root) for root in model.body_rootid[model.jnt_bodyid[model.jnt_type == kind]]}
        for kind in (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL)
    )
    moving = {int(model.body_rootid[model.jnt_bodyid[joint]]) for joint in names.joints}
    # A flexible body has three slides for each vertex.
    vertices = {int(body) for body in getattr(model, "flex_vertbodyid", ())}
    soft = {body for body in vertices & tops if not model.body_geomnum[body]}
    moving -= soft
    if driven := moving & _roots_of_actuators(model):
        moving -= (moving & free) - driven
    floating = moving & free
    if len(floating) > 1 or (floating and moving - free):
        listed = ", ".join(repr(names.bodies[body]) for body in sorted(moving))
        raise RobotError(f"{path}: holds several robots, {listed}; leave one of them in the file")
    left_out = {body for body in tops if model.body_mocapid[body] >= 0} | (free - moving) | soft
    if moving:
        left_out |= balls - moving
    # A robot on a free joint is one object; all others are scenery.
    if floating:
        left_out |= tops - floating
    for joint in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_BALL):
        body = int(model.jnt_bodyid[joint])
        if model.body_rootid[body] not in left_out:
            name = model.joint(joint).name
            problem = f"the ball joint {name!r} has no single position to control"
            raise RobotError(
                f"{path}: body {names.bodies[body]!r}: {problem}; replace it by three hinges"
            )
    for body in sorted(left_out - soft):
        text = f"is apart from the robot: {ALONE} it"
        remedy = "in SAPIEN add it with build="
        findings.append(Finding("note", "loose-link", text, remedy, link=names.bodies[body]))
    names.leave_out(left_out)
    if floating:
        return floating.pop()
    only, *others = sorted(tops - left_out) or [0]
    pose = [*model.body_pos[only], *model.body_quat[only]]
    scenery = [
        geom
        for geom in np.flatnonzero(model.geom_bodyid == 0).tolist()
        if model.geom_type[geom] != PLANE and can_collide(model, geom)
    ]
    # The only body, if it is held at the origin, is the root in place of the world.
    is_root = not (others or scenery or model.body_jntnum[only])
    if is_root and pose == [0, 0, 0, 1, 0, 0, 0]:
        return only
    return 0


def _roots_of_actuators(model: MjModel) -> set[int]:
    """Return the children of the world that actuators move, themselves or bodies below them."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    dofs = data.moment_colind[: data.moment_rownnz.sum()]
    return {int(body) for body in model.body_rootid[model.dof_bodyid[dofs]]}


class TableReader:
    """Reader of the robot with the root body ``base`` in ``model``.

    ``solid`` is the row of each body that has shapes, by the body's number.
    """

    def __init__(
        self, model: MjModel, names: Names, base: int, findings: list[Finding], motors: Motors
    ) -> None:
        self._model = model
        self._names = names
        self._base = base
        self._findings = findings
        self._motors = motors
        self._anchors = {0: ORIGIN}  # origin of each body's row, in the frame of the body
        self._bodies: list[Body] = []
        self._shapes: list[Shape] = []
        self.solid: dict[int, str] = {}

    def read(self, couplings: Couplings, is_held: bool) -> Tables:
        """Return the tables; ``is_held`` says whether a base on a free joint is fixed."""
        model = self._model
        base = self._base
        names = self._names.bodies
        if base == 0:
            self._add(0, Body(names[0], None), ORIGIN)
        else:
            self._report_world()
        # A free joint that is held keeps its turn: a row above the base has it.
        root = None
        if base != 0 and is_held and model.body_quat[base][0] != 1:
            root = Body(self._names.new_link(f"{names[base]}_frame"), None)
            self._bodies.append(root)
        rows = {0}
        for body in range(1, model.nbody):
            above = int(model.body_parentid[body])
            if body == base:
                self._read_body(body, None if root is None else root.name, couplings)
            elif above in rows - {0} or (above == 0 == base and self._names.is_of_robot(body)):
                self._read_body(body, names[above], couplings)
            else:
                continue
            rows.add(body)
        return breadth_first(self._bodies, self._shapes)

    def _read_body(self, body: int, parent: str | None, couplings: Couplings) -> None:
        """Read a body, and the joints between it and the row ``parent``; None for the root."""
        model = self._model
        name = self._names.bodies[body]
        joints = [joint for joint in self._names.joints if model.jnt_bodyid[joint] == body]
        place = model.body_pos[body] - self._anchors[int(model.body_parentid[body])]
        turn = model.body_quat[body].copy()
        anchor = ORIGIN
        if model.body_jntnum[body] > len(joints):  # on a free joint, which has the position
            place = ORIGIN
        row = Body(name, None)
        if parent is not None and not joints:
            joint = Joint(self._names.new_joint(f"{name}_fixed"), "fixed", parent, name)
            row = Body(name, joint, place, turn)
        for number in joints:
            joint_name = self._names.joints[number]
            axis = model.jnt_axis[number]
            rest = model.qpos0[model.jnt_qposadr[number]]
            if self._names.is_slide(number):
                anchor = ORIGIN
                place = place - rest * rotate(matrix_of(turn), axis)
            else:
                anchor = model.jnt_pos[number]
                place = place + rotate(matrix_of(turn), anchor)
                turn = compose(turn, about(axis, np.asarray(-rest)))
            link = name
            if number != joints[-1]:
                link = self._names.new_link(f"{name}_{joint_name}")
            joint = self._read_joint(number, str(parent), link, couplings)
            row = Body(link, joint, place, turn)
            if number != joints[-1]:
                self._bodies.append(row)
            parent = link
            place = -anchor
            turn = NO_TURN
        self._add(body, row, anchor)

    def _read_joint(self, number: int, parent: str, link: str, couplings: Couplings) -> Joint:
        model = self._model
        name = self._names.joints[number]
        dof = model.jnt_dofadr[number]
        if self._names.is_slide(number):
            kind = "prismatic"
        else:
            kind = "continuous"
        lower, upper = -np.inf, np.inf
        if model.jnt_limited[number]:
            lower, upper = model.jnt_range[number].tolist()
            kind = "prismatic" if kind == "prismatic" else "revolute"
        return Joint(
            name,
            kind,
            parent,
            link,
            lower,
            upper,
            effort_limit=self._motors.effort_limit[name],
            damping=float(model.dof_damping[dof]),
            friction=float(model.dof_frictionloss[dof]),
            mimic=Mimic(*couplings[name]) if name in couplings else None,
            axis=tuple(model.jnt_axis[number].tolist()),
        )

    def _add(self, body: int, row: Body, anchor: Float64) -> None:
        """Add a row with inertia and shapes of a body, in a frame with its origin at ``anchor``."""
        model = self._model
        self._anchors[body] = anchor
        before = len(self._shapes)
        self._read_shapes(body, row.name, anchor)
        if len(self._shapes) > before:
            self.solid[body] = row.name
        mass = float(model.body_mass[body])
        axes = model.body_iquat[body]
        center = model.body_ipos[body] - anchor
        inertia = np.diag(model.body_inertia[body])
        # Else the row would get the mass of its shapes.
        if mass == 0 and body in self.solid:
            mass = NO_MASS
            center = ORIGIN
            inertia = 1e-3 * NO_MASS * np.eye(3)
        if mass > 0:
            inertia, repair = possible_inertia(mass, inertia)
            if repair is not None:
                text, detail = repair
                remedy = "correct <inertia>"
                self._findings.append(
                    Finding("warning", "inertia", text, remedy, link=row.name, detail=detail)
                )
            row = row._replace(mass=mass, center=center, inertia=inertia, inertia_wxyz=axes.copy())
        self._bodies.append(row)

    def _read_shapes(self, body: int, link: str, anchor: Float64) -> None:
        for geom in self._geoms(body):
            vertices: Float64 | None = None
            kind: ShapeKind = "mesh"
            size: tuple[float, ...] = ()
            shape_type = int(self._model.geom_type[geom])
            sizes = self._model.geom_size[geom]
            if shape_type in _KINDS:
                kind, count = _KINDS[mujoco.mjtGeom(shape_type)]
                size = tuple(sizes[:count].tolist())
            elif shape_type in (mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_SDF):
                vertices = _hull(self._model, int(self._model.geom_dataid[geom]))
            # PhysX has no ellipsoids.
            elif shape_type == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
                vertices = _ellipsoid(sizes)
                text = "an ellipsoid collides in SAPIEN as a polyhedron inscribed in it"
                remedy = "expect its surface up to 3 % of the radii farther inside"
                self._report("note", body, text, remedy)
            else:
                self._report_shape(geom, body)
                continue
            place = self._model.geom_pos[geom] - anchor
            turn = self._model.geom_quat[geom].copy()
            self._shapes.append(Shape(link, link, kind, size, place, turn, vertices=vertices))

    def _geoms(self, body: int) -> list[int]:
        """Return the geoms of a body that can collide."""
        first = int(self._model.body_geomadr[body])
        geoms = range(first, first + int(self._model.body_geomnum[body]))
        return [geom for geom in geoms if can_collide(self._model, geom)]

    def _report_world(self) -> None:
        """Report the shapes of the world, which is not part of a robot on a free joint."""
        others = []
        for geom in self._geoms(0):
            if self._model.geom_type[geom] == PLANE:
                self._report_shape(geom, 0)
            else:
                others.append(label(self._model.geom(geom)))
        if others:
            listed = ", ".join(others)
            text = f"{ALONE} shapes of the world beside a robot on a free joint: {listed}"
            self._report("warning", None, text, "in SAPIEN add them with build= of Runner")

    def _report_shape(self, geom: int, body: int) -> None:
        """Report a plane or a height field. A plane of the world is replaced by a ground."""
        named = label(self._model.geom(geom))
        if self._model.geom_type[geom] == PLANE:
            kind = "plane"
        else:
            kind = "height field"
        text = f"{ALONE} the {kind} {named} of the file"
        # A ground at another height, or not level, changes the run.
        is_ground = not np.any([*self._model.geom_pos[geom, 2:], *self._model.geom_quat[geom, 1:3]])
        if body != 0 or kind != "plane":
            self._report("warning", body, text, "in SAPIEN add it with build=")
        elif is_ground:
            self._report("note", None, text, "SAPIEN has a ground at height 0")
        else:
            remedy = "SAPIEN has a level ground at height 0: add the plane with build="
            self._report("warning", None, text, remedy)

    def _report(self, severity: str, body: int | None, text: str, remedy: str) -> None:
        link = None if body is None else self._names.bodies[body]
        self._findings.append(Finding(severity, "collision", text, remedy, link=link))


def can_collide(model: MjModel, geom: int) -> bool:
    """Return whether a geom collides with anything, by its masks or in a ``<pair>``."""
    paired = geom in model.pair_geom1 or geom in model.pair_geom2
    return bool(model.geom_contype[geom] | model.geom_conaffinity[geom]) or paired


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
    # A body's geoms touch another's if a bit of the one's types is in the other's affinities.
    masks: dict[int, list[tuple[int, int]]] = defaultdict(list)
    for geom, body in enumerate(model.geom_bodyid.tolist()):
        masks[body].append((int(model.geom_contype[geom]), int(model.geom_conaffinity[geom])))

    def collide(first: int, second: int) -> bool:
        pair = frozenset((first, second))
        if pair in paired or pair in excluded:
            return pair in paired
        return any(
            types & other_affinities or other_types & affinities
            for types, affinities in masks[first]
            for other_types, other_affinities in masks[second]
        )

    return tuple(
        DisabledPair(solid[first], solid[second], "User")
        for first, second in combinations(solid, 2)
        if model.body_weldid[first] != model.body_weldid[second] and not collide(first, second)
    )


def _hull(model: MjModel, mesh: int) -> Float64:
    """Return the vertices (n, 3) [m] of the convex hull of a mesh, or of the mesh if it has none.

    The hull's graph has the layout of ``mesh_graph`` in MuJoCo's mjmodel.h: two counts, an address
    for each vertex, and the numbers of the vertices.
    """
    first = int(model.mesh_vertadr[mesh])
    count = int(model.mesh_vertnum[mesh])
    vertices = model.mesh_vert[first : first + count].astype(np.float64)
    begin = int(model.mesh_graphadr[mesh])
    if begin >= 0:
        corners = int(model.mesh_graph[begin])
        begin += 2 + corners
        vertices = vertices[np.sort(model.mesh_graph[begin : begin + corners])]
    return vertices


def _ellipsoid(radii: Float64) -> Float64:
    """Return vertices (n, 3) of a polyhedron with its vertices on an ellipsoid."""
    polar = np.linspace(0, np.pi, _PARALLELS)[1:-1, None]
    angle = np.arange(_MERIDIANS) * 2 * np.pi / _MERIDIANS
    rings = np.stack(
        np.broadcast_arrays(
            np.sin(polar) * np.cos(angle), np.sin(polar) * np.sin(angle), np.cos(polar)
        ),
        -1,
    )
    poles = [[0, 0, 1], [0, 0, -1]]
    return np.concatenate([rings.reshape(-1, 3), poles]) * radii
