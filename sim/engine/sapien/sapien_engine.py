"""SAPIEN as an :class:`batchpid.sim.engine.protocol.Engine`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, get_args

from batchpid.sim.engine.protocol import Capability, Engine
from batchpid.sim.engine.sapien.dynamics import Dynamics, loaded_dynamics, robot_dynamics, scene_dynamics
from batchpid.sim.engine.sapien.link_masses import link_masses
from batchpid.sim.engine.sapien.missed_contact import MissedContacts
from batchpid.sim.engine.sapien.pack import Pack
from batchpid.sim.engine.sapien.physics import PHYSICS, Physics
from batchpid.sim.engine.sapien.self_contact import self_contact
from batchpid.sim.engine.sapien.variation import VariedPack
from batchpid.sim.engine.scene_spec import SceneSpec, Variation
from batchpid.sim.robot.description import RobotDescription
from batchpid.sim.robot.parts import LinkMass
from batchpid.sim.robot.self_collision import SelfContact


class SapienEngine:
    """SAPIEN with PhysX on the CPU, with all capabilities. Implements :class:`batchpid.sim.engine.protocol.Engine`."""

    name, title = "sapien", "SAPIEN"
    capabilities: frozenset[Capability] = frozenset(get_args(Capability))
    physics: Mapping[str, Any] = PHYSICS
    group_size = 16
    shares_systems = True

    def is_physics(self, settings: object) -> bool:
        """Return whether these are :class:`batchpid.sim.Physics`."""
        return isinstance(settings, Physics)

    def make_pack(
        self,
        spec: SceneSpec,
        size: int,
        first_env: int = 0,
        system_size: int = 8,
        variation: Variation | None = None,
        carrier: str = "",
        links: Sequence[str] = (),
    ) -> Pack:
        """Return a new pack, with at most ``system_size`` scenes to a PhysX system."""
        if variation is None:
            return Pack(spec, size, first_env, system_size)
        return VariedPack(spec, size, first_env, system_size, variation, carrier, links)

    def scene_dynamics(self, spec: SceneSpec) -> Dynamics:
        """Return the model that SAPIEN derives from the URDF of ``spec``."""
        return scene_dynamics(spec)

    def robot_dynamics(self, robot: RobotDescription, ground: bool | None = None) -> Dynamics:
        """Return the model of ``robot`` on a fixed base."""
        return robot_dynamics(robot, ground)

    def loaded_dynamics(self, robot: RobotDescription, payload: float) -> Dynamics:
        """Return the model with a payload [kg] at the tool."""
        return loaded_dynamics(robot, payload)

    def missed_contacts(self, spec: SceneSpec, size: int, ground: bool) -> MissedContacts:
        """Return the record of contacts of robots without shapes."""
        return MissedContacts(spec, size, ground)

    def self_contact(self, robot: RobotDescription) -> SelfContact:
        """Return the pairs of links that do not collide."""
        return self_contact(robot)

    def link_masses(self, robot: RobotDescription) -> Mapping[str, LinkMass]:
        """Return the mass of every link of the URDF."""
        return link_masses(robot)


ENGINE: Engine = SapienEngine()
