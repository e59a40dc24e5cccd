r"""Bodies and joints of a compiled MJCF file as the links and joints of a URDF.

Masses and inertias are taken from the compiled bodies. A hinge with anchor p, axis a and reference
angle q0 moves its body by Trans(p) Rot(a, q - q0) Trans(-p), so that the link of the URDF, whose
origin is the anchor, is at::

    origin = X Trans(p) Rot(a, -q0)        link = origin Rot(a, q)        body = link Trans(-p)

with X the pose of the body before this joint, in the link below; a slide moves by Trans(a (q -
q0)), with p = 0. Several joints of one body become a chain of links, of which the last has the
mass. (MuJoCo's documentation, "Computation", kinematic tree.)
"""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
from lxml import etree
from numpy.typing import NDArray

from batchpid.arrays.array_types import MjModel
from batchpid.errors import RobotError
from batchpid.sim.robot.findings import Finding
from batchpid.sim.robot.link_repair import MOMENTS
from batchpid.sim.robot.mjcf.mjcf_compiler import ALONE, Names
from batchpid.sim.robot.mjcf.mjcf_motors import Couplings, Motors, roots_of_actuators
from batchpid.sim.robot.mjcf.mjcf_shapes import PLANE, ShapeWriter, can_collide, text_of
from batchpid.task_space.rotations import about, multiply, rotate, to_rpy
from batchpid.task_space.spatial_inertia import rotation_matrix

NO_MASS = 1e-9
"""Mass [kg] of a link with shapes and without mass: a URDF reader would give it the mass of its
shapes.
"""
_NO_TURN = np.array([1.0, 0.0, 0.0, 0.0])


class Tree:
    """Links and joints of the robot in ``model``, as elements of ``root``.

    ``base`` is the body of the root, 0 for the world. ``solid`` is the name of the link of each
    body that has shapes. The joints of other objects are removed from ``names``. Raises RobotError
    if there is a ball joint, or more than one robot.
    """

    def __init__(
        self, model: MjModel, names: Names, path: Path, fixed_base: bool, findings: list[Finding]
    ) -> None:
        self._model = model
        self._names = names
        self._path = path
        self._findings = findings
        self._shapes = ShapeWriter(model, names, findings)
        self._anchors = {0: np.zeros(3)}  # origin of each body's link, in the frame of the body
        self.root = etree.Element("robot")
        self.solid: dict[int, str] = {}
        self.base, self._left_out = self._find_base(fixed_base)
        self._is_held = fixed_base  # also a base on a free joint
        names.leave_out(self._left_out)

    def write(self, motors: Motors, couplings: Couplings) -> None:
        """Write the robot."""
        base, left_out = self.base, self._left_out
        name = self._names.bodies[base]
        parent = None
        if base == 0:
            self._write_content(0, name, self._link(name))
        else:
            self._shapes.leave_out(0)
        if base != 0 and self._is_held and self._model.body_quat[base][0] != 1:
            parent = self._names.new_link(f"{name}_frame")
            self._link(parent)
        parents = {base: name}
        for body in range(1, self._model.nbody):
            above = int(self._model.body_parentid[body])
            if body == base or (above in parents and body not in left_out):
                parents[body] = self._names.bodies[body]
                self._write_body(
                    body, parent if body == base else parents[above], motors, couplings
                )

    def _find_base(self, fixed_base: bool) -> tuple[int, set[int]]:
        """Return the body of the root, 0 for the world, and the bodies directly in the world that
        are left out.
        """
        model, names = self._model, self._names.bodies
        tops = {body for body in range(1, model.nbody) if model.body_parentid[body] == 0}
        free, balls = (
            {int(root) for root in model.body_rootid[model.jnt_bodyid[model.jnt_type == kind]]}
            for kind in (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL)
        )
        moving = {int(model.body_rootid[model.jnt_bodyid[joint]]) for joint in self._names.joints}
        soft = {
            int(body)
            for body in getattr(model, "flex_vertbodyid", ())
            if not model.body_geomnum[body]
        } & tops
        moving -= soft  # three slides for each vertex of a flexible body
        if driven := moving & roots_of_actuators(model):
            moving -= (moving & free) - driven
        floating = moving & free
        if len(floating) > 1 or (floating and moving - free):
            listed = ", ".join(repr(names[body]) for body in sorted(moving))
            raise RobotError(
                f"{self._path}: holds several robots, {listed}; leave one of them in the file"
            )
        left_out = {body for body in tops if model.body_mocapid[body] >= 0} | (free - moving)
        left_out |= (
            (tops - floating if floating else set()) | (balls - moving if moving else set()) | soft
        )
        for joint in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_BALL):
            of_body = int(model.jnt_bodyid[joint])
            if model.body_rootid[of_body] not in left_out:
                problem = (
                    f"the ball joint {model.joint(joint).name!r} has no single position to control"
                )
                raise RobotError(
                    f"{self._path}: body {names[of_body]!r}: {problem}; replace it by three hinges"
                )
        for body in sorted(left_out - soft):
            text, remedy = (
                f"is apart from the robot: {ALONE} it",
                "in SAPIEN add it with build= of Runner",
            )
            self._findings.append(Finding("note", "loose-link", text, remedy, link=names[body]))
        if floating:
            if fixed_base:
                text = "the root has a free joint, but is fixed to the world"
                remedy = "load with fixed_base=False for a robot that is free to move"
                self._findings.append(Finding("note", "joint-type", text, remedy))
            return floating.pop(), left_out
        only, *others = sorted(tops - left_out) or [0]
        pose = [*model.body_pos[only], *model.body_quat[only]]
        scenery = any(
            model.geom_bodyid[geom] == 0
            and model.geom_type[geom] != PLANE
            and can_collide(model, geom)
            for geom in range(model.ngeom)
        )
        alone = (
            not others
            and not scenery
            and not model.body_jntnum[only]
            and pose == [0, 0, 0, 1, 0, 0, 0]
        )
        return (only if alone else 0), left_out

    def _write_body(
        self, body: int, parent: str | None, motors: Motors, couplings: Couplings
    ) -> None:
        """Write the link of a body, and the joints between it and the link ``parent``; None for the
        root.
        """
        model, name = self._model, self._names.bodies[body]
        joints = [joint for joint in self._names.joints if model.jnt_bodyid[joint] == body]
        above = int(model.body_parentid[body])
        place = model.body_pos[body] - self._anchors[above]
        turn, anchor = model.body_quat[body], np.zeros(3)
        if model.body_jntnum[body] > len(joints):  # on a free joint, which has the position
            place = np.zeros(3)
        if parent is not None and not joints:
            self._joint(self._names.new_joint(f"{name}_fixed"), "fixed", parent, name, place, turn)
        for joint in joints:
            own = self._names.joints[joint]
            axis = model.jnt_axis[joint]
            rest = model.qpos0[model.jnt_qposadr[joint]]
            if self._names.is_slide(joint):
                kind, anchor, place = "prismatic", np.zeros(3), place - rest * rotate(turn, axis)
            else:
                kind = "revolute" if model.jnt_limited[joint] else "continuous"
                anchor = model.jnt_pos[joint].copy()
                place, turn = (
                    place + rotate(turn, anchor),
                    multiply(turn, about(axis, np.asarray(-rest))),
                )
            link = name
            if joint != joints[-1]:
                link = self._names.new_link(f"{name}_{own}")
                self._link(link)
            element = self._joint(own, kind, str(parent), link, place, turn)
            self._write_motion(element, joint, motors, couplings)
            parent = link
            place = -anchor
            turn = _NO_TURN
        self._anchors[body] = anchor
        self._write_content(body, name, self._link(name))

    def _write_motion(
        self, element: etree._Element, joint: int, motors: Motors, couplings: Couplings
    ) -> None:
        """Write axis, limits, friction and damping, and coupling of a joint."""
        model = self._model
        name = self._names.joints[joint]
        dof = self._model.jnt_dofadr[joint]
        etree.SubElement(element, "axis", xyz=text_of(model.jnt_axis[joint]))
        lower, upper = (
            model.jnt_range[joint].tolist() if model.jnt_limited[joint] else (-np.inf, np.inf)
        )
        limit = etree.SubElement(element, "limit", lower=repr(lower), upper=repr(upper))
        if np.isfinite(motors.effort_limit[name]):
            limit.set("effort", repr(motors.effort_limit[name]))
        if name in motors.rate:
            limit.set("velocity", repr(float(motors.rate[name])))
        damping, friction = (
            model.dof_damping[dof] + motors.damping[name],
            model.dof_frictionloss[dof],
        )
        etree.SubElement(
            element, "dynamics", damping=repr(float(damping)), friction=repr(float(friction))
        )
        if name in couplings:
            leader, multiplier, offset = couplings[name]
            etree.SubElement(
                element, "mimic", joint=leader, multiplier=repr(multiplier), offset=repr(offset)
            )

    def _write_content(self, body: int, name: str, link: etree._Element) -> None:
        """Write inertia and shapes of a body to its link."""
        model, anchor = self._model, self._anchors[body]
        if self._shapes.write(body, link, anchor):
            self.solid[body] = name
        mass, axes = float(model.body_mass[body]), rotation_matrix(model.body_iquat[body])
        tensor, center = (axes * model.body_inertia[body]) @ axes.T, model.body_ipos[body] - anchor
        if mass == 0:
            if body not in self.solid:
                return
            mass = NO_MASS
            tensor = 1e-3 * NO_MASS * np.eye(3)
            center = np.zeros(3)
        inertial = etree.SubElement(link, "inertial")
        etree.SubElement(inertial, "origin", xyz=text_of(center))
        etree.SubElement(inertial, "mass", value=repr(mass))
        entries = map(repr, tensor[np.triu_indices(3)].tolist())
        etree.SubElement(inertial, "inertia", dict(zip(MOMENTS, entries, strict=True)))

    def _link(self, name: str) -> etree._Element:
        return etree.SubElement(self.root, "link", name=name)

    def _joint(
        self,
        name: str,
        kind: str,
        parent: str,
        child: str,
        place: NDArray[np.float64],
        turn: NDArray[np.float64],
    ) -> etree._Element:
        element = etree.SubElement(self.root, "joint", name=name, type=kind)
        etree.SubElement(element, "parent", link=parent)
        etree.SubElement(element, "child", link=child)
        etree.SubElement(element, "origin", xyz=text_of(place), rpy=text_of(to_rpy(turn)))
        return element
