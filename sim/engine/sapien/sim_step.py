"""Sim step of a group of robots as one native call, which a program of XLA can make as well."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.sim.engine.native.interface import Group
from batchpid.sim.engine.sapien.calls import EngineCalls
from batchpid.sim.engine.sapien.contact_watch import ContactWatch
from batchpid.sim.engine.sapien.native_calls import (
    NativeCalls,
    contact_maps,
    gateway_address,
    gateway_sim_step,
    pointer,
)


class NativeStep:
    """Sim step of the robots of a pack: apply efforts, step, read, and judge whether Python has to look.

    Parameters
    ----------
    calls
        Present calls of the pack, which have to be native.
    systems
        PhysX system of each robot.
    watch
        Watch of the pack, judged and updated in place.
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
    """

    def __init__(
        self,
        calls: EngineCalls,
        systems: Sequence[Any],
        watch: ContactWatch,
        gravity: bool,
        coriolis: bool,
        velocities: bool,
        speed_limit: NDArray[np.float64] | None,
        constraint: int | None = None,
        joints: Sequence[Any] | None = None,
    ) -> None:
        assert isinstance(calls, NativeCalls)
        numbers = {system: number for number, system in enumerate(calls.systems)}
        system_of = [numbers[system] for system in systems]
        self._watch, self._looked_at = watch, list[Any]()
        contacts = contact_maps(calls.gateway)
        if not all(contacts):
            raise RuntimeError("the contacts of SAPIEN's systems are not where they are looked for")
        regions, count = watch.regions, len(system_of)
        pairs = regions.arms.shape[1]
        bodies = sorted((pointer(link, "body"), row) for link, (row, _) in watch.links.items())
        self._outside, self._watched = np.zeros(count, np.uint8), np.zeros(len(contacts), np.uint8)
        limit = None if speed_limit is None else np.broadcast_to(speed_limit, calls.qf.shape[1:]).astype(np.float64)
        arrays = {
            "qf": calls.qf,
            "skip": calls.skip,
            "system_of": np.array(system_of, np.int64),
            "contacts": np.array(contacts, np.uint64),
            "watched": self._watched,
            "bodies": np.array([body for body, _ in bodies], np.uint64),
            "robot_of": np.array([row for _, row in bodies], np.int64),
            "known": regions.known,
            "places": regions.places,
            "arms": np.ascontiguousarray(regions.arms),
            "sizes": regions.sizes,
            "used": np.zeros(pairs),
            "outside": self._outside,
        } | ({} if limit is None else {"speed_limit": limit})
        if joints is not None:
            arrays["joints"] = np.array([pointer(joint, "joint") for joint in joints], np.uint64)
        self._group = Group(
            gateway=gateway_address(calls.gateway),
            robots=count,
            dof=calls.qf.shape[1],
            pairs=pairs,
            bodies_size=len(bodies),
            gravity=gravity,
            coriolis=coriolis,
            velocities=velocities,
            constraint=constraint,
            **{name: array.ctypes.data for name, array in arrays.items()},
        )
        self._kept = calls, arrays

    def prepare(self) -> int:
        """Return the address of the group, for a call of the extension or of XLA, after what changed in its watch."""
        if self._looked_at is not self._watch.systems:
            self._looked_at = self._watch.systems
            self._watched[...] = [system in self._looked_at for system in self._kept[0].systems]
        return ctypes.addressof(self._group)

    def left(self) -> list[int]:
        """Return the robots that left their regions in the last sim step."""
        return np.flatnonzero(self._outside).tolist()

    def __call__(self, *arrays: NDArray[np.float64]) -> int:
        """Do one sim step: (effort, qpos, qvel, passive force), each (robots, dof); return the status."""
        return gateway_sim_step(self.prepare(), *arrays)

    @property
    def message(self) -> str:
        """Message of SAPIEN's exception, after the status FAILED."""
        return self._group.message.decode(errors="replace")
