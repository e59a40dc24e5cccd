"""Randomization: distributions of a robot's parameters, drawn by (seed, env, episode).

Each env has a stream, by default its index, and counts its episodes. The draws of one field come
from the counter-based generator Philox4x64 (J. K. Salmon et al., "Parallel random numbers: as easy
as 1, 2, 3", SC 2011) with the key (seed, hash of the field's name) and a counter that begins at (0,
push, episode, stream), with the number of earlier pushes in the episode. So they depend on these
alone, and not on other envs, fields or earlier episodes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

import batchpid as bp
from batchpid.arrays.array_types import Document, Float64, Rows
from batchpid.arrays.field_tables import Field as Bounds
from batchpid.arrays.field_tables import declared, in_group
from batchpid.checks import choice, instance, integer, read_array
from batchpid.errors import InvalidArgumentError
from batchpid.motors import JOINT_SIDE
from batchpid.sim.randomization.distributions import (
    FIELD_GROUPS,
    SINGLE,
    Distribution,
    Draws,
    Episodes,
    Field,
    elements,
    generators,
    mapping,
    parts,
    read_field,
)
from batchpid.sim.robot.robot import Robot
from batchpid.sim.robot.robot_model import link_tree

Drawn = TypeVar("Drawn", bp.PIDParams, bp.Actuators | None)
LARGEST_SEED = 2**63 - 1
LEADER_FIELDS = ("bias", *JOINT_SIDE)
"""Fields of the actuators that followers do not have."""


def env_streams(seed: ArrayLike, num_envs: int, first_env: int = 0) -> Episodes:
    """Return the stream of each env (envs,): ``seed`` plus its number, or its entry of ``seed``.

    Raises InvalidArgumentError if one is negative or not a whole number, or their number is wrong.
    """
    streams = read_array("seed", seed, "iu").astype(np.int64)
    if streams.ndim == 0:
        streams = streams + first_env + np.arange(num_envs)
    # A sum beyond the largest int is negative, too.
    if streams.shape != (num_envs,) or streams.min() < 0:
        problem = f"must be a whole number >= 0, or {num_envs} of them, one for each env"
        raise InvalidArgumentError("seed", problem, value=seed, remedy="pass an int")
    return streams


@dataclass(frozen=True, kw_only=True)
class Randomization:
    """Distributions of the parameters of the robots, for the option ``randomization`` of
    :class:`batchpid.sim.Runner`.

    A field is a distribution (:class:`batchpid.sim.Uniform`, :class:`batchpid.sim.LogUniform`,
    :class:`batchpid.sim.Normal`), drawn for each joint or link, or a
    mapping of the names of some joints or links to distributions.

    The controller knows the nominal robot: compensation and mass matrix do not change.

    Raises
    ------
    InvalidArgumentError
        A field is neither a distribution nor such a mapping.
    """

    seed: int = 0
    """Seed of all draws."""
    per: Literal["episode", "env"] = "episode"
    """Draw for each ``"episode"``, when it begins with a reset, or once for each ``"env"``."""
    payload: Annotated[Distribution | None, Bounds("kg", group="robot")] = None
    """Mass at the center of mass of ``payload_link`` [kg]; nominal 0."""
    payload_link: str | None = None
    """Link that carries the payload; default the last before the fingers."""
    link_mass: Annotated[Field | None, Bounds("kg", above=True, group="robot")] = None
    """Masses of the links of the URDF [kg]; their inertia tensors change in proportion."""
    center_of_mass: Annotated[Field | None, Bounds("m", low=-math.inf, group="robot")] = None
    """Displacement of the centers of mass of the links, along each of the three axes of the link
    [m]; nominal 0.
    """
    friction: Annotated[Field | None, Bounds("N m or N", group="robot")] = None
    """Coulomb friction of the joints [N m or N]; nominal as in the URDF."""
    damping: Annotated[Field | None, Bounds("N m s/rad or N s/m", group="robot")] = None
    """Viscous damping of the joints [N m s/rad or N s/m]; nominal as in the URDF."""
    armature: Annotated[Field | None, Bounds("kg m^2 or kg", group="robot")] = None
    """Reflected inertia of the motors [kg m^2 or kg]; nominal 0."""
    qpos: Annotated[Field | None, Bounds("rad or m", low=-math.inf, group="start")] = None
    """Position at a reset [rad or m], within the joint limits; nominal the argument of
    ``reset``.
    """
    qvel: Annotated[Field | None, Bounds("rad/s or m/s", low=-math.inf, group="start")] = None
    """Velocity at a reset [rad/s or m/s]."""
    ground_friction: Annotated[Distribution | None, Bounds("1", group="robot")] = None
    """Coefficient of sliding friction of the ground and of all shapes of the robot; nominal 0.3.

    In the scene of an MJCF file the nominal value is the friction of the file's ground, and the
    robot's shapes change by the same factor.
    """
    gravity: Annotated[Field | None, Bounds("m/s^2", low=-math.inf, group="robot")] = None
    """Gravity along the axes x, y and z of the world [m/s^2]; nominal 0, 0 and -9.81. The
    compensation has the nominal one.
    """
    push: Annotated[Field | None, Bounds("m/s or rad/s", low=-math.inf, group="event")] = None
    """Velocity change of a floating base, along the axes of the world: vx, vy, vz [m/s], wx, wy, wz
    [rad/s]; nominal
    0. Pushes come at the beginning of the first tick after each ``push_interval``.
    """
    push_interval: Annotated[Distribution | None, Bounds("s", above=True, group="event")] = None
    """Time from the reset to the first push, and from each to the next [s]."""
    latency: Annotated[Distribution | None, Bounds("s", group="policy")] = None
    """Age that is added to the latency of each chunk of a plan [s]; nominal 0."""
    params: Mapping[str, Field] = field(default_factory=dict)
    """Fields of :class:`batchpid.PIDParams` that the runner's params have, e.g. ``{"kp": ...}``."""
    actuators: Mapping[str, Field] = field(default_factory=dict)
    """Fields of :class:`batchpid.Actuators`, e.g. ``{"command_delay": ...}``; nominal the values of
    the runner's actuators, or of ideal ones.
    """

    def __post_init__(self) -> None:
        # The class is frozen; its __dict__ is not. Mappings stay as they are now.
        vars(self).update(_copied(vars(self)), seed=integer("seed", self.seed, 0, LARGEST_SEED))
        choice("per", self.per, ("episode", "env"))
        for group in FIELD_GROUPS:
            mapping(group, getattr(self, group))
        for name, value in self.distributions.items():
            distributions: list[object] = [value]
            # A mapping without names draws nothing, and is refused.
            if value and isinstance(value, Mapping) and name not in SINGLE:
                distributions = list(value.values())
            for part in distributions:
                remedy = "pass e.g. Uniform(0, 0.5), or a mapping of names to distributions"
                instance(name, part, Distribution, remedy)  # type: ignore[type-abstract]

    @property
    def distributions(self) -> dict[str, Field]:
        """Fields that are drawn, by name; fields of a group as "group.name"."""
        values = {name: getattr(self, name) for name in RANDOMIZED_FIELDS}
        for group in FIELD_GROUPS:
            values |= {f"{group}.{name}": value for name, value in getattr(self, group).items()}
        return {name: value for name, value in values.items() if value is not None}

    @property
    def changes_robot(self) -> bool:
        """True if the simulated robots differ from the model."""
        return any(getattr(self, name) is not None for name in PHYSICAL)

    def carrier(self, robot: Robot) -> str:
        """Return the name of the link that carries the payload."""
        return self.payload_link or link_tree(robot).tool

    # -- draws
    # ----------------------------------------------------------------------------------------------

    def draw(self, robot: Robot, episodes: Rows) -> Draws:
        """Return the draws for envs with these streams and episodes (envs, 2)."""
        episodes = episodes.astype(np.int64)
        draws = {}
        for name in self.distributions:
            if name not in EVENTS:
                draws[name] = self.draw_field(name, robot, episodes)
        return Draws(episodes, draws)

    def draw_field(
        self,
        name: str,
        robot: Robot,
        episodes: Episodes,
        number: ArrayLike = 0,
    ) -> Float64:
        """Return draws of a field (envs, elements), NaN where nothing is drawn; see
        :func:`generators`.

        For an event ``number`` (envs,) is that of the push before it in the episode, 0 for the
        reset.
        """
        columns = elements(name, robot)
        rows = np.full((len(episodes), len(columns)), np.nan)
        for part, chosen, distribution in parts(name, self.distributions[name], columns):
            streams = generators(self.seed, part, episodes, self.per == "env", number)
            # Each env draws from a stream of its own, in the order of the columns.
            if distribution.shared:
                size = 1
            else:
                size = len(chosen)
            for row, generator in zip(rows, streams, strict=True):
                row[chosen] = distribution.sample(generator, size)
        return rows

    def redraw(
        self,
        robot: Robot,
        draws: Draws,
        mask: NDArray[np.bool_],
        seed: int | ArrayLike | None,
        first_env: int = 0,
    ) -> Draws:
        """Return ``draws`` with new ones for the envs of ``mask`` (envs,), which begin an episode.

        It is the next of each env's stream, or the first of the stream ``seed`` + k for env number
        k, from ``first_env`` on, or of ``seed`` (envs,). The first draws, of all envs, have a seed.

        Raises
        ------
        InvalidArgumentError
            A seed is negative or not a whole number, or the seeds are not one for each env.
        """
        episodes = draws.episodes + np.array([0, 1])
        if seed is not None:
            streams = env_streams(seed, len(mask), first_env)
            episodes = np.stack([streams, np.zeros_like(streams)], 1)
        if mask.all():
            return self.draw(robot, episodes)
        return draws.replaced(mask, self.draw(robot, episodes[mask]))

    def apply(
        self,
        name: str,
        nominal: ArrayLike,
        draws: Draws,
        robot: Robot,
    ) -> Float64:
        """Return the values of a field (envs, joints or links) that result from ``nominal``, which
        broadcasts to it.
        """
        drawn = draws.values[name]
        shape = np.broadcast_shapes(np.shape(nominal), drawn.shape)
        values = np.array(np.broadcast_to(nominal, shape))
        for _, chosen, distribution in parts(name, self.distributions[name], elements(name, robot)):
            values[:, chosen] = distribution.apply(values[:, chosen], drawn[:, chosen])
        return values

    def randomized(
        self,
        group: str,
        record: Drawn,
        draws: Draws | None,
        robot: Robot,
    ) -> Drawn:
        """Return params or actuators, the fields of the ``group``, with the draws applied: one row
        for each env; the same if nothing is drawn for them.

        Actuators come from :func:`batchpid.sim.randomization.checks.prepared_actuators`.
        """
        if draws is None or record is None or not getattr(self, group):
            return record
        values: Document = {}
        for name in getattr(self, group):
            rows = self.apply(f"{group}.{name}", getattr(record, name), draws, robot)
            # Followers have no motor.
            if name in LEADER_FIELDS:
                values[name] = rows * robot.independent
            else:
                values[name] = rows
        return record._replace(**values)

    def start(
        self,
        qpos: Float64,
        qvel: Float64,
        draws: Draws,
        robot: Robot,
    ) -> tuple[Float64, Float64]:
        """Return position and velocity (envs, dof) at a reset to ``qpos`` and ``qvel``; NaN
        stays.
        """
        if self.qpos is not None:
            qpos = np.clip(self.apply("qpos", qpos, draws, robot), robot.lower, robot.upper)
        if self.qvel is not None:
            qvel = self.apply("qvel", qvel, draws, robot)
        return qpos, qvel

    # -- files
    # ----------------------------------------------------------------------------------------------

    @classmethod
    def from_dict(cls, document: Mapping[str, object]) -> Randomization:
        """Return the randomization that a file describes: ``{"payload": {"uniform": [0, 0.5]},
        ...}``.

        Raises
        ------
        InvalidArgumentError
            It is not a randomization, or has an unknown field.
        """
        names = [entry.name for entry in fields(cls)]
        values: Document = dict(mapping("randomization", document))
        for name, value in values.items():
            choice("randomization", name, names)
            if name in RANDOMIZED_FIELDS:
                values[name] = read_field(name, value)
            if name in FIELD_GROUPS:
                group = mapping(name, value).items()
                values[name] = {key: read_field(f"{name}.{key}", part) for key, part in group}
        return cls(**values)


def _copied(value: Any) -> Any:
    """Return a copy of the mappings in ``value``."""
    if isinstance(value, Mapping):
        return {name: _copied(part) for name, part in value.items()}
    return value


RANDOMIZED_FIELDS = declared(Randomization, Bounds)
PHYSICAL = in_group(RANDOMIZED_FIELDS, "robot")
"""Fields that change the simulated robot."""
START = in_group(RANDOMIZED_FIELDS, "start")
"""Fields that change the state at a reset."""
EVENTS = in_group(RANDOMIZED_FIELDS, "event")
"""Fields that change the state during an episode."""
