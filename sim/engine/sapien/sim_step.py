"""Sim step of a group of robots as one native call, which a program of XLA can make as well."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Rows
from batchpid.sim.engine.native.interface import Group
from batchpid.sim.engine.sapien.calls import EngineCalls
from batchpid.sim.engine.sapien.native_calls import NativeCalls, gateway_address, gateway_sim_step, pointer

_SENSE = ctypes.CFUNCTYPE(None, ctypes.c_int64)


class NativeStep:
    """Sim step of the robots of a pack: apply efforts, step, read, and check whether a robot has failed.

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
        Function that reads the sensors of the links of a robot after its sim step, or None.
    """

    def __init__(
        self,
        calls: EngineCalls,
        stepped: NDArray[np.bool_],
        gravity: bool,
        coriolis: bool,
        velocities: bool,
        speed_limit: NDArray[np.float64] | None,
        constraint: int | None = None,
        joints: Sequence[Any] | None = None,
        sense: Callable[[int], None] | None = None,
    ) -> None:
        assert isinstance(calls, NativeCalls)
        count, dof = calls.qf.shape
        arrays: dict[str, Rows] = {"qf": calls.qf, "skip": calls.skip}
        if speed_limit is not None:
            arrays["speed_limit"] = np.broadcast_to(speed_limit, dof).astype(np.float64)
        if joints is not None:
            arrays["joints"] = np.array([pointer(joint, "joint") for joint in joints], np.uint64)
        self._group = Group(
            gateway=gateway_address(calls.gateway),
            robots=count,
            dof=dof,
            gravity=gravity,
            coriolis=coriolis,
            velocities=velocities,
            constraint=constraint,
            **{name: array.ctypes.data for name, array in arrays.items()},
        )
        sensing = None if sense is None else _SENSE(sense)
        self._group.sense = None if sensing is None else ctypes.cast(sensing, ctypes.c_void_p)
        self._stepped, self._kept = stepped, (calls, arrays, sensing)

    def prepare(self) -> int:
        """Return the address of the group, for a call of the extension or of XLA that does a sim step."""
        self._stepped[...] = True
        return ctypes.addressof(self._group)

    def __call__(self, *arrays: NDArray[np.float64]) -> int:
        """Do one sim step: (effort, qpos, qvel, passive force), each (robots, dof); return the status."""
        return gateway_sim_step(self.prepare(), *arrays)

    @property
    def message(self) -> str:
        """Message of SAPIEN's exception, after the status FAILED."""
        return self._group.message.decode(errors="replace")
