r"""Robots in native code: mass matrices and passive forces, also within the sim steps of a tick,
and the step itself.

The equations are those of :mod:`batchpid.task_space.tree_quantities`, on a base that is held or
floats.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np

import batchpid.task_space as ts
from batchpid.arrays.array_types import Array, Float64, Rows
from batchpid.motors.coupling import Coupling
from batchpid.motors.friction import DEADBEAT_SHARE, Friction, FrictionState
from batchpid.sim.engine import native
from batchpid.sim.engine.native import WIDTH, number, structure
from batchpid.task_space.rigid_tree import Bodies, RigidTree

ALIGNMENT = 64
"""Alignment of vectors in memory [bytes]."""


def aligned(*shape: int) -> Float64:
    """Return an array of zeros whose memory begins where a vector may."""
    size = 8 * int(np.prod(shape))
    memory = np.zeros(size + ALIGNMENT, np.uint8)
    start = -memory.ctypes.data % ALIGNMENT
    rows: Float64 = memory[start : start + size].view(np.float64).reshape(shape)
    return rows


def table(rows: Rows, size: int) -> Float64:
    """Return ``rows`` (size | 1, columns) in blocks (blocks, columns, WIDTH), as lanes of native
    code read them.
    """
    blocks = -(-size // WIDTH)
    out = aligned(blocks, rows.shape[1], WIDTH)
    numbers = np.minimum(np.arange(blocks * WIDTH), size - 1)
    padded = np.broadcast_to(rows, (size, rows.shape[1]))[numbers]
    out[...] = padded.reshape(blocks, WIDTH, -1).swapaxes(1, 2)
    return out


class TreeModel:
    """Model of the robots of a ``tree`` in NumPy, whose base is "fixed", "held" where it is, or
    "free": the definition of :class:`NativeModel`.
    """

    def __init__(self, tree: Callable[[], RigidTree], base: str = "fixed") -> None:
        # Read at the first use: a robot with closed loops has no tree.
        self._read = tree
        self._base = base
        self._bodies: Bodies | None = None

    @cached_property
    def _tree(self) -> RigidTree:
        tree = self._read()
        return tree if self._base == "free" else tree.held

    def vary(self, rows: Sequence[int], added: Mapping[str, Float64]) -> None:
        """Add spatial inertias (M, 6, 6) to links, by name, of M robots, of which ``rows`` change.

        They are :func:`batchpid.task_space.frames.spatial_matrix`, in the axes of the
        links.
        """
        self._bodies = self._tree.varied(added)

    def mass_matrix(self, qpos: Rows) -> Float64:
        """Return the mass matrices (n, dof, dof) [kg m^2 or kg] that the joints show at ``qpos``
        (n, dof).
        """
        return np.asarray(ts.mass_matrix(self._tree, qpos, self._bodies), np.float64)

    def passive_force(
        self,
        qpos: Float64,
        qvel: Float64,
        gravity: bool,
        coriolis: bool,
        base: Float64 | None = None,
    ) -> Float64:
        """Return the efforts (n, dof) [N m or N] that cancel gravity, and Coriolis and centrifugal
        forces: parts of :func:`batchpid.task_space.bias`.

        ``base`` (n, 6) are gravity [m/s^2] and the rate [rad/s] at which a base that is not fixed
        turns, in its own axes: :meth:`batchpid.sim.engine.protocol.EnginePack.read_base_motion`.
        The gravity part of a free base is 0.
        """
        tree = self._tree
        bodies = self._bodies
        zero = np.zeros_like(np.asarray(qpos, np.float64))
        turning = None
        if base is not None:
            turning = base[:, 3:]
            bodies = (bodies or tree.bodies)._replace(gravity=base[:, :3])
        force = ts.bias(
            tree, qpos, qvel if coriolis else zero, turning if coriolis else None, bodies=bodies
        )
        if not gravity:
            force = force - ts.bias(tree, qpos, zero, bodies=bodies)
        return np.asarray(force, np.float64)


class NativeModel(TreeModel):
    """Model in native code, with ``inertias`` (robots, dof + 1, 13) where they differ:
    :meth:`RigidTree.inertias`.
    """

    def __init__(
        self,
        tree: Callable[[], RigidTree],
        base: str = "fixed",
        inertias: Float64 | None = None,
    ) -> None:
        super().__init__(tree, base)
        self._native = native.extension("_gateway")
        self._inertias = inertias

    @cached_property
    def _structure(self) -> tuple[Any, Any]:
        tree, rows = self._tree.tables
        if self._inertias is None:
            inertias = self._tree.inertias()[None]
        else:
            inertias = self._inertias
        arrays: dict[str, Rows] = {"tree": tree, "rows": rows, "inertias": inertias}
        addresses = {name: array.ctypes.data for name, array in arrays.items()}
        numbers = {
            "dof": len(tree),
            "varies": self._inertias is not None,
            "base": number("Base", self._base.upper()),
        }
        gravity = tuple(self._tree.bodies.gravity)
        return structure("Model")(
            gravity=gravity,
            **numbers,
            **addresses,
        ), arrays

    @property
    def address(self) -> int:
        """Address of the model, for structures of the extension."""
        return ctypes.addressof(self._structure[0])

    def vary(self, rows: Sequence[int], added: Mapping[str, Float64]) -> None:
        """Do :meth:`TreeModel.vary` in place, since native code has the address."""
        tree = self._tree
        if self._inertias is None:
            # From now on the robots have different inertias.
            size = len(next(iter(added.values())))
            self.__dict__.pop("_structure", None)
            self._inertias = np.tile(tree.inertias(), (size, 1, 1))
        picked = np.asarray(rows, np.intp)
        varied = tree.varied({name: rows[picked] for name, rows in added.items()})
        self._inertias[picked] = tree.inertias(varied)

    def mass_matrix(self, qpos: Rows) -> Float64:
        """Return :meth:`TreeModel.mass_matrix`."""
        rows = np.ascontiguousarray(qpos, np.float64)
        out = np.empty((*rows.shape, rows.shape[1]))
        self._native.joint_matrices(self.address, rows, out, len(rows))
        return out

    def passive_force(
        self,
        qpos: Float64,
        qvel: Float64,
        gravity: bool,
        coriolis: bool,
        base: Float64 | None = None,
    ) -> Float64:
        """Return :meth:`TreeModel.passive_force`."""
        state = [
            None if rows is None else np.ascontiguousarray(rows, np.float64)
            for rows in (qpos, qvel, base)
        ]
        out = np.empty(qpos.shape)
        self._native.forces(
            self.address,
            gravity,
            coriolis,
            *state,
            out,
            len(out),
        )
        return out


class NativeRefresh:
    """:func:`batchpid.motors.friction.refresh` of a group of envs, with the joints' mass matrices,
    in native code.

    Parameters
    ----------
    model
        Model of the robots, with their differences.
    size
        Number of envs M.
    armature
        Reflected inertia of the motors (1 | M, dof) [kg m^2 or kg].
    friction, drive
        Friction, and damping and stiffness of the engine's drives, each (1 | M, dof).
    coupling
        Coupling of the joints.
    timestep
        [s]
    steps
        Sim steps between two updates.
    """

    def __init__(
        self,
        model: NativeModel,
        size: int,
        armature: Float64,
        friction: Friction,
        drive: tuple[Array, Array],
        coupling: Coupling,
        timestep: float,
        steps: int,
    ) -> None:
        self._native = native.extension("_gateway")
        shape = (size, armature.shape[1])
        if friction.viscous is None:
            viscous: Array = 0.0
        else:
            viscous = friction.viscous
        named = {"armature": armature, "coulomb": friction.most, "viscous": viscous}
        named |= dict(zip(("damping", "stiffness"), drive, strict=True))
        arrays = {
            name: np.array(np.broadcast_to(rows, shape), np.float64, order="C")
            for name, rows in named.items()
        }
        arrays |= coupling.native()
        addresses = {name: array.ctypes.data for name, array in arrays.items()}
        self._structure = structure("Refresh")(
            model=model.address,
            timestep=timestep,
            share=DEADBEAT_SHARE,
            steps=steps,
            **addresses,
        )
        self._kept = model, arrays

    @property
    def address(self) -> int:
        """Address of the constants, for a tick of the extension."""
        return ctypes.addressof(self._structure)

    def __call__(self, state: FrictionState, qpos: Float64) -> FrictionState:
        """Return ``state`` with its factors at ``qpos`` (M, dof)."""
        factors = np.empty(qpos.shape), np.empty(qpos.shape)
        self._native.refresh(
            self.address, np.ascontiguousarray(qpos, np.float64), *factors, len(qpos)
        )
        return state._replace(gain=factors[0], memory=factors[1])


class NativeStep:
    """Sim step of ``robots`` with ``dof`` joints as one native call, from Python or from an XLA
    program.

    ``arrays`` and ``fields`` fill a Group of sim_step.h.
    """

    def __init__(
        self,
        robots: int,
        dof: int,
        arrays: Mapping[str, Rows],
        **fields: object,
    ) -> None:
        self._arrays = dict(arrays)
        addresses = {name: array.ctypes.data for name, array in self._arrays.items()}
        self._native = native.extension("_gateway")
        self._group = structure("Group")(
            robots=robots,
            dof=dof,
            **addresses,
            **fields,
        )

    def prepare(self) -> int:
        """Return the address of the group, for a call of the extension that does a sim
        step.
        """
        return ctypes.addressof(self._group)

    def __call__(self, *arrays: Float64) -> int:
        """Do one sim step: (effort, qpos, qvel, passive force), each (robots, dof); return the
        status.
        """
        status: int = self._native.sim_step(self.prepare(), *arrays)
        return status

    def may_have_failed(self, status: int) -> bool:
        """Return whether an env may have failed in a sim step with this status; RuntimeError if the
        engine has.
        """
        if status and status & number("Status", "FAILED"):
            raise RuntimeError(self._group.message.decode(errors="replace"))
        return bool(status)
