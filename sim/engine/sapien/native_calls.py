"""Native calls into SAPIEN: reads and writes of all robots of a pack in one call of the extension.

The extension calls functions that SAPIEN's shared library exports, so that it needs nothing of SAPIEN to be compiled.
It depends on the layout of two of SAPIEN's types, which no header promises: see
:data:`batchpid.sim.engine.native.library.TESTED`.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import DType, Rows
from batchpid.sim.engine.native import SWITCH, extension
from batchpid.sim.engine.native.library import functions
from batchpid.sim.engine.sapien.calls import EngineCalls, PythonCalls

_ABI = b"system_libstdcpp_gxx_abi_1xxx_use_cxx11_abi_1"
_capsule_name = ctypes.PYFUNCTYPE(ctypes.c_char_p, ctypes.py_object)(("PyCapsule_GetName", ctypes.pythonapi))
_capsule_pointer = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.py_object, ctypes.c_char_p)(
    ("PyCapsule_GetPointer", ctypes.pythonapi)
)


def engine_calls(
    robots: Sequence[Any], systems: Sequence[Any], qf: NDArray[np.float32], skip: NDArray[np.bool_], native: bool
) -> EngineCalls:
    """Return native calls, or Python's; both take the arguments before ``native``."""
    make = NativeCalls if robots and native else PythonCalls
    return make(robots, systems, qf, skip)


class NativeCalls:
    """Calls of :class:`~batchpid.sim.engine.sapien.calls.PythonCalls`, for all robots; RuntimeError if SAPIEN fails."""

    def __init__(
        self, robots: Sequence[Any], systems: Sequence[Any], qf: NDArray[np.float32], skip: NDArray[np.bool_]
    ) -> None:
        self._objects = [*robots], [*systems]  # kept alive, since the gateway has their pointers
        pointers = [[pointer(item, kind) for item in items] for kind, items in (("robot", robots), ("system", systems))]
        self._native = extension("_gateway")
        self.gateway = self._native.gateway(functions(), *pointers, qf.shape[1])
        self.qf, self.skip = qf, skip

    def qpos(self, dtype: DType) -> Rows:
        """Return the joint positions, a new array."""
        rows = np.empty(self.qf.shape, dtype)
        self._native.read_qpos(self.gateway, rows)
        return rows

    def qvel(self, dtype: DType) -> Rows:
        """Return the joint velocities, a new array."""
        rows = np.empty(self.qf.shape, dtype)
        self._native.read_qvel(self.gateway, rows)
        return rows

    def passive_force(self, gravity: bool, coriolis: bool, dtype: DType) -> Rows:
        """Return the efforts that cancel gravity and Coriolis and centrifugal forces, a new array."""
        rows = np.empty(self.qf.shape, dtype)
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


def pointer(wrapper: Any, kind: str) -> int:
    """Return the address of the C++ object in ``wrapper``, a "robot", "system" or "joint".

    It comes by pybind11's conduit, which checks type and ABI.
    """
    capsule = wrapper._pybind11_conduit_v1_(_ABI, extension("_gateway").type_info(kind), b"raw_pointer_ephemeral")
    if capsule is None:
        problem = f"SAPIEN's {kind} is not of the type that the extension was made for"
        raise RuntimeError(f"{problem}; install SAPIEN from PyPI, or set {SWITCH}=0 for Python calls")
    return _capsule_pointer(capsule, _capsule_name(capsule))


def gateway_address(gateway: Any) -> int:
    """Return the address of the object in a gateway's capsule."""
    return extension("_gateway").address(gateway)


def gateway_sim_step(address: int, *arrays: NDArray[np.float64]) -> int:
    """Do a sim step of the group at ``address``: see :class:`batchpid.sim.engine.sapien.sim_step.NativeStep`."""
    return extension("_gateway").sim_step(address, *arrays)
