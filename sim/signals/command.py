"""Description of a command: names, units and bounds of the setpoint that a control takes for each
env.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from batchpid.checks.validate import array, entries
from batchpid.errors import InvalidArgumentError

POSE_UNITS = {"x": "m", "y": "m", "z": "m", "qw": "", "qx": "", "qy": "", "qz": ""}
"""Names and units of the numbers in a pose: position and quaternion (w, x, y, z)."""
TWIST_UNITS = {"vx": "m/s", "vy": "m/s", "vz": "m/s", "wx": "rad/s", "wy": "rad/s", "wz": "rad/s"}
"""Names and units of the numbers in a twist: linear and angular velocity."""
FORCE_UNITS = {"fx": "N", "fy": "N", "fz": "N"}
"""Names and units of the numbers in a force."""
WRENCH_UNITS = FORCE_UNITS | {"tx": "N m", "ty": "N m", "tz": "N m"}
"""Names and units of the numbers in a wrench: force and torque."""


@dataclass(frozen=True)
class CommandSpec:
    """Names, units and bounds of the numbers in a setpoint of one env.

    A :class:`batchpid.sim.Controller` whose setpoints are not one number per joint has a spec as
    its attribute ``command``. Two specs are equal if their names and units are equal.

    Raises
    ------
    InvalidArgumentError
        Names repeat, or a field does not have one entry per name.
    """

    names: tuple[str, ...]
    """Name of each entry."""
    units: tuple[str, ...] = ()
    """Unit of each entry; default "", unknown."""
    _: KW_ONLY
    lower: ArrayLike = field(default=-math.inf, compare=False)
    """Lower bounds (size,), for action spaces of :mod:`batchpid.sim.gym`; a Runner does not apply
    them.
    """
    upper: ArrayLike = field(default=math.inf, compare=False)
    """Upper bounds (size,)."""
    neutral: ArrayLike | None = field(default=None, compare=False)
    """Finite setpoint (size,) for an env that has failed; default 0, clipped to the bounds."""

    def __post_init__(self) -> None:
        names = _texts("names", self.names)
        if not names or "" in names or len(set(names)) < len(names):
            raise InvalidArgumentError(
                "names", "must be different words", value=names, remedy="name every entry once"
            )
        units = _texts("units", self.units) or ("",) * len(names)
        if len(units) != len(names):
            problem = f"has {len(units)} units for {len(names)} names"
            raise InvalidArgumentError(
                "units", problem, value=units, remedy="give one unit for each name"
            )

        def numbers(argument: str, value: ArrayLike, finite: bool = False) -> Any:
            return array(argument, value, (1, len(names)), names, finite=finite, kind="entry")[0]

        lower = numbers("lower", self.lower)
        upper = numbers("upper", self.upper)
        entries("lower", lower, lower <= upper, "is not below the upper bound", names, kind="entry")
        inside = np.clip(0.0, lower, upper)
        neutral = numbers("neutral", inside if self.neutral is None else self.neutral, finite=True)
        good = (lower <= neutral) & (neutral <= upper)
        entries("neutral", neutral, good, "is not within the bounds", names, kind="entry")
        bounds = {"lower": lower, "upper": upper, "neutral": neutral}
        tables = {name: tuple(rows.tolist()) for name, rows in bounds.items()}
        vars(self).update({"names": names, "units": units} | tables)

    @property
    def size(self) -> int:
        """Number of entries."""
        return len(self.names)

    @property
    def labels(self) -> tuple[str, ...]:
        """Names with units, such as "x [m]"."""
        return tuple(
            f"{name} [{unit}]" if unit else name
            for name, unit in zip(self.names, self.units, strict=True)
        )


def joint_command(joint_names: Sequence[str], units: Sequence[str], control: object) -> CommandSpec:
    """Return the default command of a control: joint efforts under control "effort", else joint
    positions.

    ``units`` are the units of the joint positions, "rad" or "m".
    """
    of_joints = ["N" if unit == "m" else "N m" for unit in units] if control == "effort" else units
    return CommandSpec(tuple(joint_names), tuple(of_joints))


def own_command(control: object) -> CommandSpec | None:
    """Return the attribute ``command`` of the caller's own controller; None if it has none.

    Raises
    ------
    InvalidArgumentError
        The attribute is neither a CommandSpec nor a sequence of names.
    """
    command = None if isinstance(control, str) else getattr(control, "command", None)
    if command is None or isinstance(command, CommandSpec):
        return command
    try:
        return CommandSpec(command)
    except InvalidArgumentError as error:
        problem = f"has an attribute 'command' whose {error.argument} {error.problem}"
        remedy = "use a batchpid.sim.CommandSpec, or names such as ('x', 'y')"
        raise InvalidArgumentError("control", problem, remedy=remedy) from None


def _texts(argument: str, value: object) -> tuple[str, ...]:
    sequence = isinstance(value, Sequence) and not isinstance(value, str)
    if not sequence or not all(isinstance(text, str) for text in value):  # type: ignore[attr-defined]
        raise InvalidArgumentError(
            argument,
            "must be a sequence of texts",
            value=value,
            remedy="pass a tuple such as ('x', 'y')",
        )
    return tuple(value)  # type: ignore[arg-type]
