"""Rigid tree of one robot: its links, joints and inertias, as float64 arrays.

Links are listed parents first. The frame of a joint has a fixed place in the frame of its parent
link. The frame of its child link is the joint's frame, turned about the axis by q (revolute) or
shifted along it by q (prismatic). Links that fixed joints connect are one rigid body: each link
keeps its name and its frame, and the body has the sum of the inertias (Huygens and Steiner). There
is one body for each degree of freedom, in the frame of its joint with the axis along x, and one for
the base, which is fixed or floats.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, replace
from functools import cached_property
from itertools import compress
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from batchpid.arrays.array_types import Array, Float64
from batchpid.arrays.elementwise import namespace, read_only
from batchpid.checks import array, at_least, choice, read_array
from batchpid.errors import InvalidArgumentError
from batchpid.motors.coupling import Coupling
from batchpid.task_space.frames import (
    SpatialInertia,
    about,
    compose,
    inertia_rows,
    matrix_of,
    moved_matrix,
    rotate,
    spatial_matrix,
    total,
)

GRAVITY = (0.0, 0.0, -9.81)
"""Gravity of a tree, and in the engines, unless another one is given [m/s^2]."""
MAKE_TREE = "pass robot.kinematic_tree()"
"""Remedy for a tree of another type."""


class Bodies(NamedTuple):
    """Bodies of a tree, one for each degree of freedom, and the frames of its links in them.

    The frame of body j in its parent's is ``at_zero`` turned about its x axis by q, or shifted along
    it. Inertias may differ from robot to robot: mass, center and tensor then have a leading axis
    (robots, ...). Their last row belongs to the base and the links fixed to it.
    """

    at_zero: Array
    """(dof, 3, 4): rotation and position."""
    slides: Array
    """1.0 for a prismatic joint, else 0.0 (dof, 1)."""
    mass: Array
    """(dof + 1, 1) [kg]."""
    center: Array
    """Center of mass in the body's frame (dof + 1, 3) [m]."""
    tensor: Array
    """Inertia tensor about the center of mass, in the body's axes (dof + 1, 3, 3) [kg m^2]."""
    moves: Array
    """1.0 where joint i moves body j (dof j, dof i)."""
    link_frames: Array
    """Frames of the links in their bodies (links, 3, 4)."""
    armature: Array
    gravity: Array


@dataclass(
    frozen=True,
    eq=False,
    repr=False,
)
class RigidTree:
    """Rigid tree of a robot. Arrays are copied and read-only; the degrees of freedom are the joints
    that move, in the order of their links.

    :meth:`batchpid.sim.Robot.kinematic_tree` makes one from a robot.

    Raises
    ------
    InvalidArgumentError
        Armature, limits or gravity have a wrong shape or sign. The other fields are those of a
        robot's file, which its reader has checked.
    """

    links: tuple[str, ...]
    """Names of the links, parents first; the first is the base."""
    parent: NDArray[np.intp]
    """Index of each link's parent (links,), -1 for the base."""
    joint_types: tuple[str, ...]
    """Type of the joint above each link (links,): "fixed", "revolute" or "prismatic"; "fixed" for
    the base.
    """
    joint_names: tuple[str, ...]
    """Names of the joints that move (dof,)."""
    position: Float64
    """Position of each joint in its parent link's frame (links, 3) [m]; for the base, in the
    world.
    """
    wxyz: Float64
    """Orientation of each joint there, unit quaternions (links, 4)."""
    axis: Float64
    """Axes in the joint's frame (links, 3), normalised here; unused for fixed joints."""
    mass: Float64
    """Masses of the links (links,) [kg]."""
    center: Float64
    """Centers of mass in the link's frame (links, 3) [m]."""
    inertia: Float64
    """Inertia tensors about the centers of mass, in the link's axes (links, 3, 3) [kg m^2]."""
    _: KW_ONLY
    armature: ArrayLike = 0.0
    """Reflected inertia of the motors (dof,) [kg m^2 or kg], added to the diagonal of the mass
    matrix.
    """
    lower: ArrayLike = -np.inf
    """Lower position limits (dof,) [rad or m], for inverse kinematics."""
    upper: ArrayLike = np.inf
    gravity: ArrayLike = GRAVITY
    """Acceleration of free fall in the world (3,) [m/s^2]."""
    coupling: Coupling = None  # type: ignore[assignment]
    """Coupling of the joints; None: all are independent. Jacobians, mass matrices and efforts are
    reduced to the leaders, J G, G^T M G and G^T u: columns and efforts of followers are 0, and
    their rows in a mass matrix are rows of the identity.
    """
    fixed_base: bool = True
    """False if the base floats. Mass matrices and biases of the joints are then Schur complements
    (:mod:`batchpid.task_space.tree_quantities`); poses and Jacobians are still in the frame of the
    base.
    """

    def __post_init__(self) -> None:
        moving = self.joint_names
        # One copy of each table, in float64: later writes by the caller change nothing.
        columns = ("position", "wxyz", "axis", "mass", "center", "inertia")
        tables = {name: np.array(getattr(self, name), np.float64) for name in columns}
        tables["wxyz"] /= np.linalg.norm(tables["wxyz"], axis=1)[:, None]
        lengths = np.linalg.norm(tables["axis"], axis=1)
        tables["axis"] /= np.where(lengths > 0, lengths, 1.0)[:, None]
        # Options of users: the reader of a robot's file has checked the others.
        tables["gravity"] = gravity = np.array(read_array("gravity", self.gravity), np.float64)
        if gravity.shape != (3,) or not np.isfinite(gravity).all():
            remedy = "give the acceleration of free fall along x, y and z"
            raise InvalidArgumentError("gravity", "is no vector", value=gravity, remedy=remedy)
        for name in ("armature", "lower", "upper"):
            # A number holds for all joints; an infinite limit means none.
            number = getattr(self, name)
            tables[name] = array(name, number, (len(moving),), moving, finite=False).copy()
        at_least("armature", tables["armature"], 0.0, moving)
        parent = np.array(self.parent, np.intp)
        for table in (parent, *tables.values()):
            table.setflags(write=False)
        coupling = Coupling.of(len(moving)) if self.coupling is None else self.coupling
        # The class is frozen, so the tables go past its setter.
        vars(self).update(tables, parent=parent, coupling=coupling)

    @property
    def dof(self) -> int:
        """Number of degrees of freedom."""
        return len(self.joint_names)

    def index(self, link: str) -> int:
        """Return the index of a link.

        Raises
        ------
        InvalidArgumentError
            The link is unknown.
        """
        return self.links.index(choice("link", link, self.links))

    @cached_property
    def tool(self) -> str:
        """Name of the link at the end of the longest chain of joints, or of the hand if that chain
        ends in fingers.
        """
        # Depth counts the joints that move; a branch is a subtree with at least one.
        moves = [kind != "fixed" for kind in self.joint_types]
        depth = [0] * len(self.links)
        branches = [0] * len(self.links)
        for child, above in enumerate(self.parent[1:].tolist(), start=1):
            depth[child] = depth[above] + moves[child]
        for child, above in reversed(list(enumerate(self.parent.tolist()))[1:]):
            branches[above] += moves[child] or branches[child] > 0
        link = tip = int(np.argmax(depth))
        # Fingers are short: a branching at most two joints below the tip is a hand.
        while link > 0 and depth[tip] - depth[link] <= 2:
            if branches[link] > 1:
                return self.links[link]
            link = int(self.parent[link])
        return self.links[tip]

    @cached_property
    def held(self) -> RigidTree:
        """Same tree on a fixed base, with all joints independent."""
        if self.fixed_base and self.coupling.is_identity:
            return self
        return replace(self, fixed_base=True, coupling=Coupling.of(self.dof))

    def fixed_at(self, qpos: Float64, moves: NDArray[np.bool_]) -> RigidTree:
        """Return the tree in which only the joints of the mask ``moves`` (dof,) move, and are
        independent.

        The others are fixed at ``qpos`` (dof,) [rad or m].
        """
        position = self.position.copy()
        wxyz = self.wxyz.copy()
        types = np.array(self.joint_types, object)
        above = np.flatnonzero(types != "fixed")
        # A fixed joint is the same joint with its motion multiplied into its place.
        for link, q in zip(above[~moves], np.asarray(qpos)[~moves], strict=True):
            if types[link] == "revolute":
                wxyz[link] = compose(wxyz[link], about(self.axis[link], q))
            else:
                position[link] += q * matrix_of(wxyz[link]) @ self.axis[link]
            types[link] = "fixed"
        names = tuple(compress(self.joint_names, moves))
        rows = {name: getattr(self, name)[moves] for name in ("armature", "lower", "upper")}
        return replace(
            self,
            position=position,
            wxyz=wxyz,
            joint_types=tuple(types),
            **rows,
            joint_names=names,
            coupling=Coupling.of(len(names)),
        )

    def positions(self, qpos: Array) -> Array:
        """Return ``qpos`` (..., dof) with the followers moved to match their leaders."""
        return self.coupling.positions(qpos)

    def rates(self, qvel: Array) -> Array:
        """Return ``qvel`` (..., dof) with the rates of followers computed from their leaders'."""
        return namespace(qvel).asarray(self.coupling.rates(qvel), dtype=qvel.dtype)

    def efforts(self, effort: Array) -> Array:
        """Return G^T u for u (..., dof), or J G for J (..., dof)."""
        return namespace(effort).asarray(self.coupling.efforts(effort), dtype=effort.dtype)

    def chain(self, link: str) -> NDArray[np.bool_]:
        """Return the mask (dof,) of the joints between the base and ``link``, and of joints coupled
        to them.
        """
        carried: NDArray[np.bool_] = self.chains[self.link_bodies[self.index(link)]] > 0
        return carried

    @cached_property
    def chains(self) -> Float64:
        """1.0 for the joints between the base and each body, and for joints coupled to them (dof +
        1, dof).

        The last row, body -1, is the base.
        """
        # A joint that is coupled to one of the chain moves the tool, too.
        rows = np.concatenate([self.bodies.moves, np.zeros((1, self.dof))])
        leader = self.coupling.leader
        return read_only((rows @ (leader[:, None] == leader) > 0).astype(np.float64))

    @property
    def link_bodies(self) -> tuple[int, ...]:
        """Body of each link (links,): the index of the joint that moves it, -1 for the base."""
        return self._structure[0]

    @property
    def body_parents(self) -> tuple[int, ...]:
        """Index of the parent of each body (dof,), -1 for the base."""
        return self._structure[1]

    @property
    def bodies(self) -> Bodies:
        """Bodies in float64."""
        return self._structure[2]

    @cached_property
    def _structure(self) -> tuple[tuple[int, ...], tuple[int, ...], Bodies]:
        body = list[int]()
        parents = list[int]()
        links_of = list[list[int]]()
        frames = np.zeros((len(self.links), 3, 4))
        at_zero = np.zeros((self.dof, 3, 4))
        moves = np.zeros((self.dof, self.dof))
        slides = np.zeros((self.dof, 1))
        # From the base outwards: the frame of each link in its body, and each body's placement.
        for link, above in enumerate(self.parent):
            frames[link] = np.column_stack([matrix_of(self.wxyz[link]), self.position[link]])
            if link:
                frames[link] = frames[above][:, :3] @ frames[link]
                frames[link, :, 3] += frames[above][:, 3]
            if self.joint_types[link] == "fixed":
                body.append(body[above] if link else -1)
                if body[-1] >= 0:
                    links_of[body[-1]].append(link)
                continue
            joint = len(parents)
            turn = _along_x(self.axis[link])
            at_zero[joint] = frames[link]
            at_zero[joint, :, :3] = frames[link][:, :3] @ turn
            slides[joint] = self.joint_types[link] == "prismatic"
            parents.append(body[above])
            moves[joint, joint] = 1.0
            if parents[-1] >= 0:
                moves[joint] += moves[parents[-1]]
            body.append(joint)
            links_of.append([link])
            # The body's frame has the axis along x; its link is turned back from that.
            frames[link] = np.column_stack([turn.T, np.zeros(3)])
        links_of.append([link for link, of in enumerate(body) if of < 0])
        inertias = [self._inertia(links, frames[links]) for links in links_of]
        mass, center, tensor = map(np.array, zip(*inertias, strict=True))
        leaves = (
            at_zero,
            slides,
            mass[:, None],
            center,
            tensor,
            moves,
            frames,
            self.armature,
            self.gravity,
        )
        return tuple(body), tuple(parents), Bodies(*map(read_only, leaves))

    def _inertia(self, links: list[int], frames: Float64) -> SpatialInertia:
        """Return the inertia of some links, from their ``frames`` in a body, in its frame."""
        turn = frames[..., :3]
        center = frames[..., 3] + rotate(turn, self.center[links])
        tensor = turn @ self.inertia[links] @ turn.transpose(0, 2, 1)
        return total(list(map(SpatialInertia, self.mass[links].tolist(), center, tensor)))

    @cached_property
    def tables(self) -> tuple[NDArray[np.int32], Float64]:
        """The bodies for native code: the joint above each, or -1, and 1 if it slides (dof, 2); and
        rows of numbers (dof, 25): rotation, position, mass, center, tensor.
        """
        bodies = self.bodies
        joints = np.column_stack([self.body_parents, bodies.slides[:, 0]]).astype(np.int32)
        turns = bodies.at_zero[:, :, :3].reshape(-1, 9)
        rows = np.hstack([turns, bodies.at_zero[:, :, 3], self.inertias()[:-1]])
        return read_only(joints), read_only(rows)

    def inertias(self, bodies: Bodies | None = None) -> Float64:
        """Return mass, center of mass and inertia tensor of each body, then of the base (..., dof +
        1, 13).
        """
        _, _, mass, center, tensor, *_ = bodies or self.bodies
        return np.concatenate([mass, center, tensor.reshape(*center.shape[:-1], 9)], axis=-1)

    def varied(self, added: Mapping[str, Float64]) -> Bodies:
        """Return the bodies of n robots with spatial inertias (n, 6, 6) added to links, in the axes
        of the links.
        """
        # Links that fixed joints connect add up in one body.
        of_bodies = dict[int, Float64]()
        for name, matrices in added.items():
            link = self.index(name)
            moved = moved_matrix(matrices, self.bodies.link_frames[link])
            of_bodies[self.link_bodies[link]] = of_bodies.get(self.link_bodies[link], 0.0) + moved
        rows = np.tile(self.inertias(), (len(next(iter(added.values()))), 1, 1))
        for body, matrices in of_bodies.items():
            mass, center, tensor = np.split(rows[0, body], [1, 4])
            nominal = SpatialInertia(float(mass[0]), center, tensor.reshape(3, 3))
            rows[:, body] = inertia_rows(spatial_matrix(nominal) + matrices)
        return self.bodies._replace(
            mass=rows[..., :1],
            center=rows[..., 1:4],
            tensor=rows[..., 4:].reshape(*rows.shape[:-1], 3, 3),
        )


def _along_x(axis: Float64) -> Float64:
    """Return a rotation matrix (3, 3) whose first column is the unit vector ``axis``."""
    # The coordinate axis farthest from it keeps the cross product well conditioned.
    across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    across /= np.linalg.norm(across)
    return np.column_stack([axis, across, np.cross(axis, across)])
