"""Fields of a randomization: names, the joints, links or axes that they have values for, and
nominal values.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.checks.validate import choice
from batchpid.errors import InvalidArgumentError
from batchpid.sim.randomization.distributions import Distribution, read_distribution
from batchpid.sim.robot.parts import CONTACT_FRICTION, MjcfFile
from batchpid.sim.robot.robot import Robot
from batchpid.sim.signals.command import TWIST_UNITS

Field = Distribution | Mapping[str, Distribution]
"""Distribution for all joints or links, or one for each of those that are named."""

GROUPS = ("params", "actuators")
"""Fields that are mappings, by name of a further field."""

SINGLE = ("payload", "ground_friction", "push_interval")
"""Fields of one value."""


def elements(name: str, robot: Robot) -> Sequence[str]:
    """Return the names of a field's values: joints, links, axes of links or of the world, or its
    own name.
    """
    if name in SINGLE:
        return (name,)
    if name == "gravity":
        return ("x", "y", "z")
    if name == "push":
        return tuple(TWIST_UNITS)
    if name == "center_of_mass":
        return [f"{link}.{axis}" for link in elements("link_mass", robot) for axis in "xyz"]
    if name == "link_mass":
        return [
            link.name
            for link in robot.links
            if link.mass or (link.mass is None and link.num_shapes)
        ]
    return robot.joint_names


def parts(
    name: str, each: Field, columns: Sequence[str]
) -> Iterator[tuple[str, list[int], Distribution]]:
    """Yield the name of each independent part of a field, its columns and its distribution."""
    if isinstance(each, Distribution):
        yield name, list(range(len(columns))), each
        return
    owners = [column[:-2] for column in columns] if name == "center_of_mass" else columns
    for element, distribution in each.items():
        choice(name, element, list(dict.fromkeys(owners)))
        yield (
            f"{name}.{element}",
            [at for at, owner in enumerate(owners) if owner == element],
            distribution,
        )


def nominal_values(name: str, robot: Robot, mjcf: MjcfFile | None = None) -> Float64:
    """Return the nominal values of a field of the robot (elements,), 0 for others.

    ``mjcf`` is the file that the engine simulates, with its own friction.
    """
    if name == "link_mass":
        return np.array([robot.link_masses[link].mass for link in elements(name, robot)])
    nominal = {
        "friction": robot.friction,
        "damping": robot.damping,
        "gravity": np.array([0.0, 0.0, -9.81]),
    }
    nominal |= {"ground_friction": np.array([CONTACT_FRICTION if mjcf is None else mjcf.friction])}
    return nominal.get(name, np.zeros(len(elements(name, robot))))


def mapping(name: str, value: object) -> Mapping[str, Any]:
    """Return ``value`` if it is a mapping; raise InvalidArgumentError if not."""
    if not isinstance(value, Mapping):
        remedy = "write field: distribution, e.g. kp: {uniform: [0.9, 1.1], operation: scale}"
        raise InvalidArgumentError(
            name, "is not a mapping of fields to distributions", value=value, remedy=remedy
        )
    return value


def read_field(name: str, value: Any) -> Field:
    """Return the field that a file describes: a distribution, or a mapping of names to
    distributions.
    """
    if (
        isinstance(value, Mapping)
        and value
        and all(isinstance(part, Mapping) for part in value.values())
    ):
        return {
            str(element): read_distribution(f"{name}.{element}", part)
            for element, part in value.items()
        }
    return read_distribution(name, value)
