"""What a pack does in each sim step: the step of all its robots in SAPIEN as one call of the
extension.

The extension calls functions that SAPIEN's shared library exports, so that it compiles without
SAPIEN. It depends on the layout of three of SAPIEN's types, which SAPIEN does not guarantee: see
:data:`TESTED`.
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import sapien
from sapien.physx import PhysxArticulation, PhysxCpuSystem

from batchpid.arrays.array_types import Bool, Rows
from batchpid.sim.engine import native
from batchpid.sim.engine.native import SWITCH, extension, structure
from batchpid.sim.engine.native_model import NativeStep

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
        **fields: object,
    ) -> None:
        self._stepped = stepped
        pointers = {}
        for name, kind, objects in (
            ("articulations", "robot", robots),
            ("systems", "system", systems),
            ("joints", "joint", joints),
        ):
            if objects:
                pointers[name] = np.array([pointer(item, kind) for item in objects], np.uint64)
        size, dof = arrays["qf"].shape
        address = ctypes.addressof(functions())
        arrays = {**arrays, **pointers}
        super().__init__(
            size,
            dof,
            arrays,
            functions=address,
            **fields,
        )

    def prepare(self) -> int:
        """Return the address of the group, for a call of the extension that does a sim
        step.
        """
        self._stepped[...] = True
        return super().prepare()
