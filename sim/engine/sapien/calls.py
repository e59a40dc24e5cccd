"""What a pack does in each sim step: the step of all its robots in SAPIEN as one call of the
extension; and sensors of links: contact forces, and wrenches between a link and its parent.

The extension calls functions that SAPIEN's shared library exports, so that it compiles without
SAPIEN. It depends on the layout of three of SAPIEN's types, which SAPIEN does not guarantee: see
:data:`TESTED`.

PhysX reports the normal forces of contacts, but not their friction. So the net contact force F on a
body of mass m is computed from the velocity v of its center of mass, gravity g, and the forces in
its joints, which PhysX reports::

    F = m (dv/dt - g) - (force of the parent on it) + (its forces on its children)
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import sapien
from sapien.physx import PhysxArticulation, PhysxCpuSystem

from batchpid.arrays.array_types import Bool, Float32, Float64, Rows
from batchpid.sim.engine import native
from batchpid.sim.engine.native import SWITCH, extension, number, structure
from batchpid.sim.engine.native_model import NativeStep
from batchpid.sim.engine.scene_spec import SceneSpec

TESTED = ("3.0.3",)
"""Versions of SAPIEN that native code calls; tests/sim/test_conformance.py must pass with each.

The gateway repeats the layout of three types of SAPIEN (gateway.h). No header promises it, and the
names of the functions do not contain the type that they return: a version that changes it would
corrupt memory.
"""
SYMBOLS = {
    "get_qpos": "_ZN6sapien5physx17PhysxArticulation7getQposEv",
    "get_qvel": "_ZN6sapien5physx17PhysxArticulation7getQvelEv",
    "compute_passive_force": "_ZN6sapien5physx17PhysxArticulation19computePassiveForceEbb",
    "set_qf": "_ZN6sapien5physx17PhysxArticulation5setQfERKN5Eigen6MatrixIfLin1ELi1ELi0ELin1ELi1EEE",
    "step": "_ZN6sapien5physx14PhysxSystemCpu4stepEv",
    "set_drive_position": "_ZN6sapien5physx22PhysxArticulationJoint22setDriveTargetPositionEf",
    "set_drive_velocity": "_ZN6sapien5physx22PhysxArticulationJoint22setDriveTargetVelocityEf",
    "get_root_pose": "_ZN6sapien5physx17PhysxArticulation11getRootPoseEv",
    "get_root_angular_velocity": "_ZN6sapien5physx17PhysxArticulation22getRootAngularVelocityEv",
}
"""Functions of SAPIEN, by their names in Functions of gateway.h."""


def obstacle() -> str:
    """Return why native code cannot call SAPIEN; "" if it can."""
    if reason := native.obstacle():
        return reason
    if (version := sapien.__version__) not in TESTED:
        return f"native calls are not tested with SAPIEN {version}; install sapien=={TESTED[-1]}"
    try:
        functions()
    except (OSError, AttributeError) as error:
        return f"SAPIEN {version} has another library: {error}; install sapien=={version} from PyPI"
    return ""


@cache
def functions() -> Any:
    """Return Functions of gateway.h with the exported functions; AttributeError names one that is
    missing.
    """
    folder = Path(sapien.__file__).parent
    paths = [
        path
        for place in (folder, folder.parent / "sapien.libs")
        for path in place.glob("libsapien*.so*")
    ]
    if len(paths) != 1:
        raise OSError("libsapien.so is missing, or there is more than one")
    library = ctypes.CDLL(str(paths[0]))
    addresses = {
        name: ctypes.cast(getattr(library, symbol), ctypes.c_void_p)
        for name, symbol in SYMBOLS.items()
    }
    return structure("Functions")(**addresses)


_ABI = b"system_libstdcpp_gxx_abi_1xxx_use_cxx11_abi_1"
_capsule_name = ctypes.PYFUNCTYPE(ctypes.c_char_p, ctypes.py_object)(
    ("PyCapsule_GetName", ctypes.pythonapi)
)
_capsule_pointer = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.py_object, ctypes.c_char_p)(
    ("PyCapsule_GetPointer", ctypes.pythonapi)
)


def pointer(wrapper: Any, kind: str) -> int:
    """Return the address of the C++ object in ``wrapper``, a "robot", "system" or "joint".

    It comes by pybind11's conduit, which checks type and ABI.
    """
    capsule = wrapper._pybind11_conduit_v1_(
        _ABI, extension("_gateway").type_info(kind), b"raw_pointer_ephemeral"
    )
    if capsule is None:
        problem = f"SAPIEN's {kind} is not of the type that the extension was made for"
        raise RuntimeError(
            f"{problem}; install SAPIEN from PyPI, or set {SWITCH}=0 for Python calls"
        )
    address: int = _capsule_pointer(capsule, _capsule_name(capsule))
    return address


class SapienStep(NativeStep):
    """Sim step of the robots of a pack: apply efforts, step, read, and check whether a robot has
    failed.

    Parameters
    ----------
    robots, systems
        Articulation and PhysX system of each robot.
    arrays
        ``qf`` (robots, dof), the efforts last applied, and the mask ``skip`` (robots,) of the robots
        to which none are applied.
    stepped
        Mask of the robots that did a sim step (robots,), set in place.
    joints
        Joints of all robots, if the targets of their drives move within a tick; else empty.
    sense
        Function that reads the sensors of the links after a sim step, or None. Native code returns
        to Python for it after each sim step, since Python drops exceptions of functions that C
        calls.
    fields
        Parts of the passive force that is read, and address of the constraint: see
        Group of sim_step.h.
    """

    def __init__(
        self,
        robots: Sequence[PhysxArticulation],
        systems: Sequence[PhysxCpuSystem],
        arrays: Mapping[str, Rows],
        stepped: Bool,
        joints: Sequence[object],
        sense: Callable[[], None] | None,
        **fields: object,
    ) -> None:
        self._stepped = stepped
        self._sense = sense
        pointers = {}
        for name, kind, objects in (
            ("articulations", "robot", robots),
            ("systems", "system", systems),
            ("joints", "joint", joints),
        ):
            if objects:
                pointers[name] = np.array([pointer(item, kind) for item in objects], np.uint64)
        size, dof = arrays["qf"].shape
        senses = sense is not None
        address = ctypes.addressof(functions())
        arrays = {**arrays, **pointers}
        super().__init__(
            size,
            dof,
            arrays,
            senses=senses,
            functions=address,
            **fields,
        )

    def prepare(self) -> int:
        """Return the address of the group, for a call of the extension that does a sim
        step.
        """
        self._stepped[...] = True
        return super().prepare()

    def may_have_failed(self, status: int) -> bool:
        # A call also returns to Python for the sensors; that is not a failure.
        failed = super().may_have_failed(status & ~number("Status", "SENSE"))
        if self._sense is not None:
            self._sense()
        return failed


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
        for place, at in enumerate(self._contacts):
            if at not in touched:
                continue
            rate = (velocities[place] - self._velocities[row, place]) / self._spec.timestep
            force = links[at].mass * (rate - gravity)
            if at not in self._roots:
                # What the joints transmit is not contact: of the parent on the link, and of it on its children.
                force -= _in_world(links[at], joints[at], forces[at])
            for child in self._children[at]:
                force += _in_world(links[child], joints[child], forces[child])
            self._sums["contact_force"][row, place] += force
            self._sums["touching"][row, place] += 1.0
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
