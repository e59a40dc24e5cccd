"""Calls into SAPIEN for all robots of a pack: reads, efforts, and steps of their systems.

Native calls are one call of the extension for all robots. The extension calls functions that
SAPIEN's shared library exports, so that it compiles without SAPIEN. It depends on the layout of
three of SAPIEN's types, which SAPIEN does not guarantee: see :data:`TESTED`.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import sapien
from sapien.physx import PhysxArticulation, PhysxCpuSystem

from batchpid.arrays.array_types import Bool, Float32, Float64, Rows
from batchpid.sim.engine import native
from batchpid.sim.engine.native import SWITCH, extension
from batchpid.sim.engine.native.interface import SYMBOLS, number
from batchpid.sim.engine.native_model import NativeStep

TESTED = ("3.0.3",)
"""Versions of SAPIEN that native code calls; tests/sim/test_conformance.py must pass with each.

The gateway repeats the layout of three types of SAPIEN (gateway.h). No header promises it, and the
names of the functions do not contain the type that they return: a version that changes it would
corrupt memory.
"""


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
def functions() -> tuple[int, ...]:
    """Return the addresses of the exported functions; AttributeError names one that is missing."""
    folder = Path(sapien.__file__).parent
    paths = [
        path
        for place in (folder, folder.parent / "sapien.libs")
        for path in place.glob("libsapien*.so*")
    ]
    if len(paths) != 1:
        raise OSError("libsapien.so is missing, or there is more than one")
    library = ctypes.CDLL(str(paths[0]))
    return tuple(
        ctypes.cast(getattr(library, symbol), ctypes.c_void_p).value or 0 for symbol in SYMBOLS
    )


class PythonCalls:
    """One Python call for each robot and quantity, as arrays (M, dof) in SAPIEN's order, SI units.

    ``qf`` (M, dof) of float32 are the efforts that :meth:`write_qf` applies, except to the robots
    of ``skip`` (M,). No call follows :meth:`close`. The native calls are tested against these.
    """

    def __init__(
        self,
        robots: Sequence[PhysxArticulation],
        systems: Sequence[PhysxCpuSystem],
        qf: Float32,
        skip: Bool,
    ) -> None:
        # Bound methods and kept row views: looking them up, or slicing, costs as much as the calls.
        self._shape = qf.shape
        self._get_qpos = [robot.get_qpos for robot in robots]
        self._get_qvel = [robot.get_qvel for robot in robots]
        self._passive_force = [robot.compute_passive_force for robot in robots]
        rows = zip(robots, qf, skip, strict=True)
        self._set_qf = [(robot.set_qf, row) for robot, row, skipped in rows if not skipped]
        self._steps = [system.step for system in systems]

    def qpos(self) -> Float64:
        """Return the joint positions, a new array."""
        return self._table(get() for get in self._get_qpos)

    def qvel(self) -> Float64:
        """Return the joint velocities, a new array."""
        return self._table(get() for get in self._get_qvel)

    def passive_force(self, gravity: bool, coriolis: bool) -> Float64:
        """Return the efforts that cancel gravity and Coriolis and centrifugal forces, a new
        array.
        """
        return self._table(compute(gravity, coriolis) for compute in self._passive_force)

    def _table(self, rows: Iterable[Float32]) -> Float64:
        # After close() there are no rows.
        return np.array([*rows], np.float64).reshape(self._shape)

    def write_qf(self) -> None:
        """Apply the efforts in ``qf``."""
        for set_qf, row in self._set_qf:
            set_qf(row)

    def step(self) -> None:
        """Do one sim step of every system."""
        for step in self._steps:
            step()

    def close(self) -> None:
        """Drop the references to robots and systems, so that they can be freed."""
        self._get_qpos = []
        self._get_qvel = []
        self._passive_force = []
        self._set_qf = []
        self._steps = []


_ABI = b"system_libstdcpp_gxx_abi_1xxx_use_cxx11_abi_1"
_capsule_name = ctypes.PYFUNCTYPE(ctypes.c_char_p, ctypes.py_object)(
    ("PyCapsule_GetName", ctypes.pythonapi)
)
_capsule_pointer = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.py_object, ctypes.c_char_p)(
    ("PyCapsule_GetPointer", ctypes.pythonapi)
)


class NativeCalls:
    """Calls of :class:`PythonCalls`, each for all robots at once; RuntimeError if SAPIEN fails."""

    def __init__(
        self,
        robots: Sequence[PhysxArticulation],
        systems: Sequence[PhysxCpuSystem],
        qf: Float32,
        skip: Bool,
    ) -> None:
        self._objects = [*robots], [*systems]  # kept alive, since the gateway has their pointers
        pointers = [
            [pointer(item, kind) for item in items]
            for kind, items in (("robot", robots), ("system", systems))
        ]
        self._native = extension("_gateway")
        self.gateway = self._native.gateway(functions(), *pointers, qf.shape[1])
        # The pack's own arrays, which native code reads at each call.
        self.qf, self.skip = qf, skip

    def qpos(self) -> Float64:
        """Return the joint positions, a new array."""
        rows = np.empty(self.qf.shape)
        self._native.read_qpos(self.gateway, rows)
        return rows

    def qvel(self) -> Float64:
        """Return the joint velocities, a new array."""
        rows = np.empty(self.qf.shape)
        self._native.read_qvel(self.gateway, rows)
        return rows

    def passive_force(self, gravity: bool, coriolis: bool) -> Float64:
        """Return the efforts that cancel gravity and Coriolis and centrifugal forces, a new
        array.
        """
        rows = np.empty(self.qf.shape)
        self._native.passive_force(self.gateway, rows, gravity, coriolis)
        return rows

    def write_qf(self) -> None:
        """Apply the efforts in ``qf``."""
        self._native.write_qf(self.gateway, self.qf, self.skip)

    def step(self) -> None:
        """Do one sim step of every system."""
        self._native.step(self.gateway)

    def close(self) -> None:
        """Release robots and systems."""
        self._objects = [], []


EngineCalls = PythonCalls | NativeCalls


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
    calls
        Present calls of the pack, which have to be native.
    stepped
        Mask of the robots that did a sim step (robots,), set in place.
    gravity, coriolis
        Parts of the passive force that is read; without both it is zero.
    velocities
        Whether to read velocities; otherwise they are zero.
    speed_limit
        Joint speed beyond which the status says so (dof,), or None.
    constraint
        Address of the constraint of coupled joints, or None.
    joints
        Joints of all robots, if the targets of their drives move within a tick.
    sense
        Function that reads the sensors of the links after a sim step, or None. Native code returns
        to Python for it after each sim step, since Python drops exceptions of functions that C
        calls.
    """

    def __init__(
        self,
        calls: EngineCalls,
        stepped: Bool,
        gravity: bool,
        coriolis: bool,
        speed_limit: Float64 | None,
        constraint: int | None = None,
        joints: Sequence[object] | None = None,
        sense: Callable[[], None] | None = None,
    ) -> None:
        assert isinstance(calls, NativeCalls)
        self._stepped = stepped
        self._calls = calls
        self._sense = sense
        arrays: dict[str, Rows] = {"qf": calls.qf, "skip": calls.skip}
        if joints is not None:
            arrays["joints"] = np.array([pointer(joint, "joint") for joint in joints], np.uint64)
        robots, dof = calls.qf.shape
        super().__init__(
            robots,
            dof,
            arrays,
            speed_limit,
            gateway=extension("_gateway").address(calls.gateway),
            gravity=gravity,
            coriolis=coriolis,
            constraint=constraint,
            senses=sense is not None,
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
