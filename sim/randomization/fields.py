"""Fields of a randomization: names, the joints, links or axes that they have values for, and
nominal values.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

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
_AXES: dict[str, Sequence[str]] = {"gravity": ("x", "y", "z"), "push": tuple(TWIST_UNITS)}
"""Fields of the world or the base, and their axes."""


def elements(name: str, robot: Robot) -> Sequence[str]:
    """Return the names of a field's values: joints, links, axes of links or of the world, or its
    own name.
    """
    if name in SINGLE:
        return (name,)
    if name in _AXES:
        return _AXES[name]
    if name not in ("link_mass", "center_of_mass"):
        return robot.joint_names
    links = [
        link.name for link in robot.links if link.mass or (link.mass is None and link.num_shapes)
    ]
    if name == "link_mass":
        return links
    return [f"{link}.{axis}" for link in links for axis in "xyz"]


def parts(
    name: str, field: Field, columns: Sequence[str]
) -> Iterator[tuple[str, list[int], Distribution]]:
    """Yield the name of each independent part of a field, its columns and its distribution."""
    if isinstance(field, Distribution):
        yield name, list(range(len(columns))), field
        return
    owners = [column[:-2] for column in columns] if name == "center_of_mass" else columns
    for element, distribution in field.items():
        choice(name, element, list(dict.fromkeys(owners)))
        chosen = [at for at, owner in enumerate(owners) if owner == element]
        yield f"{name}.{element}", chosen, distribution


def nominal_values(name: str, robot: Robot, mjcf: MjcfFile | None = None) -> Float64:
    """Return the nominal values of a field of the robot (elements,), 0 for others.

    ``mjcf`` is the file that the engine simulates, with its own friction.
    """
    if name == "link_mass":
        return np.array([robot.link_masses[link].mass for link in elements(name, robot)])
    if name in ("friction", "damping"):
        if name == "friction":
            return robot.friction
        return robot.damping
    if name == "gravity":
        return np.array([0.0, 0.0, -9.81])
    if name == "ground_friction":
        return np.array([CONTACT_FRICTION if mjcf is None else mjcf.friction])
    return np.zeros(len(elements(name, robot)))


def mapping(name: str, value: object) -> Mapping[str, object]:
    """Return ``value`` if it is a mapping; raise InvalidArgumentError if not."""
    if not isinstance(value, Mapping):
        remedy = "write field: distribution, e.g. kp: {uniform: [0.9, 1.1], operation: scale}"
        raise InvalidArgumentError(
            name, "is not a mapping of fields to distributions", value=value, remedy=remedy
        )
    return value


def read_field(name: str, value: object) -> Field:
    """Return the field that a file describes: a distribution, or a mapping of names to
    distributions.
    """
    elements = value if isinstance(value, Mapping) else {}
    if not elements or not all(isinstance(part, Mapping) for part in elements.values()):
        return read_distribution(name, value)
    return {
        str(element): read_distribution(f"{name}.{element}", part)
        for element, part in elements.items()
    }
