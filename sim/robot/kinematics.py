"""Batched forward kinematics and the transposed Jacobian, in NumPy.

A joint's frame is its parent link's frame moved by the joint's origin; its link's frame is that, turned about the axis
by q (revolute, continuous) or shifted along it by q (prismatic). See B. Siciliano et al., Robotics (2009), sections 2.8
and 3.1.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from batchpid.arrays.array_types import Float64
from batchpid.checks.validate import choice
from batchpid.sim.robot.description import RobotDescription
from batchpid.task_space.rotations import about, from_rpy, multiply, rotate


class Poses(NamedTuple):
    """Link frames in the world: ``position`` (..., links, 3) [m], ``wxyz`` (..., links, 4) unit quaternions."""

    position: Float64
    wxyz: Float64


class _Step(NamedTuple):
    """Joint of the tree, with the index of its parent link."""

    parent: int
    xyz: Float64
    wxyz: Float64
    axis: Float64
    dof: int | None
    slides: bool


class Kinematics:
    """Kinematics of ``robot``, its root link at the origin. ``links`` names the links in the order of the poses."""

    def __init__(self, robot: RobotDescription) -> None:
        dofs = {name: index for index, name in enumerate(robot.joint_names)}
        children = {joint.child_link for joint in robot.all_joints}
        links = [link.name for link in robot.links if link.name not in children]
        self._steps: list[_Step] = []
        for joint in robot.all_joints:  # parents first
            axis = np.array(joint.axis) / max(float(np.linalg.norm(joint.axis)), 1e-12)
            frame = np.array(joint.origin), from_rpy(joint.rpy), axis
            parent = links.index(joint.parent_link)
            self._steps.append(_Step(parent, *frame, dofs.get(joint.name), joint.type == "prismatic"))
            links.append(joint.child_link)
        self.links = tuple(links)
        self.dof = robot.dof

    def index(self, link: str) -> int:
        """Return the index of a link in the poses."""
        return self.links.index(choice("link", link, self.links))

    @property
    def tool(self) -> int:
        """Index of the link at the end of the longest chain of joints, or of the hand if that chain ends in fingers."""
        depth, branches = [0] * len(self.links), [0] * len(self.links)
        for child, step in enumerate(self._steps, start=1):
            depth[child] = depth[step.parent] + (step.dof is not None)
        for child, step in reversed(list(enumerate(self._steps, start=1))):
            branches[step.parent] += step.dof is not None or branches[child] > 0
        link = tip = int(np.argmax(depth))
        while link > 0 and depth[tip] - depth[link] <= 2:
            if branches[link] > 1:
                return link
            link = self._steps[link - 1].parent
        return tip

    def poses(self, qpos: ArrayLike) -> Poses:
        """Return the link poses at ``qpos`` (..., dof) [rad or m]."""
        q = np.asarray(qpos, np.float64)
        batch = q.shape[:-1]
        position, wxyz = np.zeros((len(self.links), *batch, 3)), np.zeros((len(self.links), *batch, 4))
        wxyz[0, ..., 0] = 1.0
        for child, step in enumerate(self._steps, start=1):
            at, turn = position[step.parent], wxyz[step.parent]
            position[child] = at + rotate(turn, step.xyz)
            turn = multiply(turn, np.broadcast_to(step.wxyz, turn.shape))
            if step.dof is None:
                wxyz[child] = turn
            elif step.slides:
                position[child] += rotate(turn, step.axis * q[..., step.dof, None])
                wxyz[child] = turn
            else:
                wxyz[child] = multiply(turn, about(step.axis, q[..., step.dof]))
        return Poses(np.moveaxis(position, 0, -2), np.moveaxis(wxyz, 0, -2))

    def efforts_of_force(self, poses: Poses, link: int, force: ArrayLike) -> Float64:
        """Return the joint efforts (..., dof) of a ``force`` (..., 3) [N] on the origin of a link: tau = J^T F.

        A revolute joint between the root and the link contributes axis . ((p - o) x F), with p the point and o the
        joint's origin, a prismatic one axis . F.
        """
        f = np.broadcast_to(np.asarray(force, np.float64), (*poses.position.shape[:-2], 3))
        point = poses.position[..., link, :]
        efforts = np.zeros((*f.shape[:-1], self.dof))
        while link > 0:
            step = self._steps[link - 1]
            if step.dof is not None:
                axis = rotate(poses.wxyz[..., link, :], step.axis)
                arm = np.cross(point - poses.position[..., link, :], f)
                efforts[..., step.dof] = (axis * (f if step.slides else arm)).sum(-1)
            link = step.parent
        return efforts
