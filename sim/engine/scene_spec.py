"""Description of the envs of a pack: the robot and its scene, and how each robot differs from the
model; and the settings of the engines' solvers, with their presets.

A variation changes a robot's inertias, and the friction and damping of its joints.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.motors import Actuators
from batchpid.motors.friction import Friction
from batchpid.sim.description.merging import (
    Part,
    body_tree,
    coupling_of,
    merge_links,
    payload_place,
    place_links,
    varied_bodies,
)
from batchpid.sim.description.tables import Joint, MjcfFile, Tables
from batchpid.task_space.frames import SpatialInertia, spatial_matrix, total
from batchpid.task_space.rigid_tree import GRAVITY, RigidTree


@dataclass(frozen=True)
class Physics:
    """Solver of a PhysX scene, "TGS" or "PGS" (temporal or projected Gauss-Seidel), and its
    iterations per sim step.
    """

    solver: str
    position_iterations: int
    velocity_iterations: int = 1


PHYSICS = {
    # SAPIEN's own settings.
    "accurate": Physics("TGS", 10),
    # At 2 kHz PGS keeps its error with 4 iterations, which TGS does not; see docs/performance.md.
    "fast": Physics("PGS", 4),
}


@dataclass(frozen=True)
class MujocoSolver:
    """Settings of MuJoCo's constraint solver, which acts on contacts and joint limits, and on
    constraints of a file.

    The integrator is always semi-implicit Euler, as PhysX's is. See "Computation" in MuJoCo's
    documentation.
    """

    iterations: int = 100
    """Largest number of iterations of Newton's method per sim step."""
    tolerance: float = 1e-8
    """Relative improvement of the cost at which it ends."""
    elliptic: bool = True
    """Whether friction cones are elliptic, not pyramids, which are faster and slip a little."""
    contact_time: float = 0.005
    """Time constant of contacts [s], at least two sim steps; an MJCF file gives its own."""


SOLVERS = {
    "accurate": MujocoSolver(),
    "fast": MujocoSolver(
        iterations=20,
        tolerance=1e-6,
        elliptic=False,
    ),
}
"""Presets, by the names of the option ``physics``."""


Build = Callable[[Any, int], Any]
"""``build(scene, env)`` adds actors and articulations to the engine's scene of env ``env``; returns
the entities whose poses are read, or None.
"""


@dataclass(frozen=True)
class SceneSpec:
    """Everything that a scene is built from, picklable.

    ``tables`` are the rows of the robot's file; ``ignored`` are pairs of its links that do not
    collide; ``joints`` are the degrees of freedom, in the order of all arrays.
    ``physics`` are the solver settings, in the engine's type. Without ``collisions``
    scenes have no collision shapes and no ground, but the same masses and inertias. ``mjcf`` is the
    file that MuJoCo compiles in place of ``tables``. ``contacts`` and ``wrenches`` are links with
    sensors. ``carrier`` is the link that carries payloads, and ``varied_links`` are those whose mass
    or center of mass varies. With ``drives`` the engine's drives move the joints. Specs that differ
    in ``build`` alone are equal.
    """

    tables: Tables
    ignored: tuple[tuple[str, str], ...]
    joints: tuple[Joint, ...]
    timestep: float
    physics: Any
    dissipation: str = "urdf"
    ground: bool = True
    fixed_base: bool = True
    collisions: bool = True
    build: Build | None = field(default=None, compare=False)
    gravity: tuple[float, float, float] = GRAVITY
    contacts: tuple[str, ...] | None = None
    wrenches: tuple[str, ...] | None = None
    mjcf: MjcfFile | None = None
    carrier: str = ""
    varied_links: tuple[str, ...] = ()
    drives: bool = False

    @property
    def simulated(self) -> Tables:
        """Tables of the simulated bodies."""
        return merge_links(self.tables, self.separate)

    @cached_property
    def rigid_tree(self) -> RigidTree:
        """Rigid tree of the simulated bodies, all joints independent."""
        return body_tree(self.simulated, self.fixed_base, self.gravity)

    @cached_property
    def separate(self) -> tuple[str, ...]:
        """Links that begin a body although a fixed joint holds them: those with a wrench sensor,
        and links with shapes in a body of which another link has a contact sensor, for its own.
        """
        wrenches = self.wrenches or ()
        places = place_links(self.tables, wrenches)
        owners = defaultdict[str, set[str]](set)
        for shape in self.tables.shapes:
            owners[places[shape.owner].link].add(shape.owner)
        divided = list[str]()
        for link in self.contacts or ():
            if owners[places[link].link] - {link}:
                divided += [link, *sorted(owners[places[link].link])]
        return tuple(dict.fromkeys((*wrenches, *divided)))

    @property
    def is_alone(self) -> bool:
        """True if nothing moves but the joints of the robot."""
        return self.fixed_base and (self.mjcf is None or self.mjcf.is_alone)


class Variation(NamedTuple):
    """Differences of some robots from the model, one row for each; None: no difference."""

    payload: Float64 | None = None
    """Mass added at the center of mass of a link (envs,) [kg]."""
    link_mass: Float64 | None = None
    """Mass of each link relative to its mass in the URDF (envs, links); NaN for 1."""
    center_of_mass: Float64 | None = None
    """Displacement of the center of mass of each link of the URDF in the link's frame (envs, 3
    links) [m]: x, y, z of the first link, of the second, ...
    """
    friction: Float64 | None = None
    """Coulomb friction of the joints (envs, dof) [N m or N]."""
    damping: Float64 | None = None
    """Viscous damping of the joints (envs, dof) [N m s/rad or N s/m]."""
    armature: Float64 | None = None
    """Reflected inertia of the motors (envs, dof) [kg m^2 or kg]."""
    ground_friction: Float64 | None = None
    """Coefficient of sliding friction of the ground and all shapes of the robot (envs,)."""
    gravity: Float64 | None = None
    """(envs, 3) [m/s^2]"""


class VariedMasses:
    """Inertias of the simulated links of ``size`` robots that differ by ``variation``, one row for
    each.

    Attributes
    ----------
    added
        Spatial inertias (size, 6, 6) of the links that vary, by name, minus the model's; empty if
        no mass varies.
    """

    def __init__(self, spec: SceneSpec, size: int, variation: Variation) -> None:
        self._variation = variation
        self._bodies: dict[str, list[Part]] = {}
        varies_links = variation.link_mass is not None or variation.center_of_mass is not None
        if varies_links or variation.payload is not None:
            links = spec.varied_links if varies_links else ()
            self._bodies = varied_bodies(spec.tables, spec.separate, spec.carrier, links)
            self._payload = payload_place(spec.tables, spec.separate, spec.carrier)
        self._nominal = {
            name: total([part.inertia for part in parts]) for name, parts in self._bodies.items()
        }
        self.added = {name: np.zeros((size, 6, 6)) for name in self._bodies}

    def of_robot(self, row: int) -> dict[str, SpatialInertia]:
        """Return the present inertias of robot ``row`` by link, in the frames of the links;
        :attr:`added` gets them.
        """
        inertias = {name: self._inertia(name, row) for name in self._bodies}
        for name, inertia in inertias.items():
            self.added[name][row] = spatial_matrix(inertia) - spatial_matrix(self._nominal[name])
        return inertias

    def _inertia(self, body: str, row: int) -> SpatialInertia:
        """Return the inertia of a body with its links as in ``row``, and with the payload."""
        parts = []
        variation = self._variation
        for part in self._bodies[body]:
            (mass, center, tensor) = part.inertia
            column = part.column
            share = 1.0
            if variation.link_mass is not None and column is not None:
                # The inertia tensor grows with the mass, as of the same body of another density.
                share = float(np.nan_to_num(variation.link_mass[row, column], nan=1.0))
            if variation.center_of_mass is not None and column is not None:
                displacement = variation.center_of_mass[row, 3 * column : 3 * column + 3]
                center = center + part.axes @ np.nan_to_num(displacement)
            parts.append(SpatialInertia(share * mass, center, share * tensor))
        if variation.payload is not None and body == self._payload.link:
            mass = float(variation.payload[row])
            parts.append(SpatialInertia(mass, self._payload.position, np.zeros((3, 3))))
        return total(parts)


def own_friction(spec: SceneSpec, variation: Variation | None = None) -> Friction:
    """Return the friction and damping that the loop applies to robots of ``spec``, with
    ``variation``.
    """
    model = Friction()
    if spec.dissipation == "urdf":
        rows = (
            np.array([[getattr(joint, name) for joint in spec.joints]])
            for name in ("friction", "damping")
        )
        model = Friction(*(row if row.any() else None for row in rows))
    if variation is not None and variation.friction is not None:
        # The coupling moves the others.
        model = model._replace(coulomb=coupling_of(spec.joints).of_independent(variation.friction))
    if variation is not None and variation.damping is not None:
        model = model._replace(viscous=variation.damping.copy())
    if spec.mjcf is not None:
        # MuJoCo computes the damping of a file.
        return model._replace(viscous=None)
    return model


def added_friction(own: Friction, actuators: Actuators | None) -> Friction:
    """Return ``own`` friction and damping plus the actuators' friction and damping."""
    added = Actuators() if actuators is None else actuators
    static, load = added.static, added.load_friction
    coulomb = _sum(own.coulomb, added.coulomb)
    viscous = _sum(own.viscous, added.viscous)
    if static is not None and own.coulomb is not None:
        static = static + own.coulomb
    if coulomb is None and (rubs := Friction(None, None, static, load=load).most) is not None:
        # Friction of the other kinds alone still needs an array of Coulomb friction.
        coulomb = np.zeros_like(rubs)
    return Friction(coulomb, viscous, static, added.stribeck, load)


def _sum(first: Float64 | None, second: Float64 | None) -> Float64 | None:
    if first is None:
        return second
    if second is None:
        return first
    # A randomization may draw less friction than the actuators take away.
    return np.maximum(first + second, 0.0)
