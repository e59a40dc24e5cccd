"""Commands and observations: names, units and shapes of their numbers.

A sensor is one line of :class:`Observation`: dtype, text, unit, columns, and the option that it
belongs to. Shared memory, snapshots, recordings and rollouts take names and shapes from that line.
Its value comes from ``NativeExecutor._copies`` in native ticks and ``EnvGroup.observe`` in others,
or from the engine's sensors of links; :class:`batchpid.sim.Runner` adds the pose of the tool.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from operator import itemgetter
from typing import Annotated, NamedTuple, get_type_hints

import numpy as np
from numpy.typing import ArrayLike

from batchpid.arrays.array_types import Bool, DType, Float32, Rows
from batchpid.checks import array, instance
from batchpid.checks import names as different_names
from batchpid.errors import InvalidArgumentError

POSE_UNITS = {
    "x": "m",
    "y": "m",
    "z": "m",
    "qw": "",
    "qx": "",
    "qy": "",
    "qz": "",
}
"""Names and units of the numbers in a pose: position and quaternion (w, x, y, z)."""
TWIST_UNITS = {
    "vx": "m/s",
    "vy": "m/s",
    "vz": "m/s",
    "wx": "rad/s",
    "wy": "rad/s",
    "wz": "rad/s",
}
"""Names and units of the numbers in a twist: linear and angular velocity."""
FORCE_UNITS = {"fx": "N", "fy": "N", "fz": "N"}
"""Names and units of the numbers in a force."""
WRENCH_UNITS = FORCE_UNITS | {"tx": "N m", "ty": "N m", "tz": "N m"}
"""Names and units of the numbers in a wrench: force and torque."""


@dataclass(frozen=True)
class CommandSpec:
    """Names and units of the numbers in a setpoint of one env.

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
    neutral: ArrayLike = field(default=0.0, compare=False)
    """Finite setpoint (size,) for an env that has failed; default 0."""

    def __post_init__(self) -> None:
        names = tuple(different_names("names", self.names))
        units = tuple(self.units) or ("",) * len(names)
        are_texts = all(isinstance(unit, str) for unit in units)
        if isinstance(self.units, str) or not are_texts or len(units) != len(names):
            problem = "must be a sequence of texts"
            remedy = "give one for each name"
            raise InvalidArgumentError("units", problem, value=self.units, remedy=remedy)
        neutral = array("neutral", self.neutral, (1, len(names)), names, kind="entry")[0]
        # The class is frozen; its __dict__ is not.
        vars(self).update(
            names=names,
            units=units,
            neutral=tuple(neutral.tolist()),
        )

    @property
    def size(self) -> int:
        """Number of entries."""
        return len(self.names)

    @property
    def labels(self) -> tuple[str, ...]:
        """Names with units, such as "x [m]"."""
        labels = []
        for name, unit in zip(self.names, self.units, strict=True):
            labels.append(f"{name} [{unit}]" if unit else name)
        return tuple(labels)


def joint_command(joint_names: Sequence[str], units: Sequence[str], control: object) -> CommandSpec:
    """Return the default command of a control: joint efforts under control "effort", else joint
    positions.

    ``units`` are the units of the joint positions, "rad" or "m".
    """
    if control == "effort":
        units = ["N" if unit == "m" else "N m" for unit in units]
    return CommandSpec(tuple(joint_names), tuple(units))


def own_command(control: object) -> CommandSpec | None:
    """Return the attribute ``command`` of the caller's own controller; None if it has none.

    Raises
    ------
    InvalidArgumentError
        The attribute is no CommandSpec.
    """
    # A control that is a word has no attribute of this name.
    command = getattr(control, "command", None)
    if command is None:
        return None
    remedy = "let its attribute 'command' be a batchpid.sim.CommandSpec"
    return instance("control", command, CommandSpec, remedy)


class Quantity(NamedTuple):
    """Declaration of an observed quantity."""

    dtype: DType
    meaning: str
    unit: str = "1"
    """Unit; "rad|m" is the unit of the joint's position."""
    columns: Mapping[str, str] | None = None
    """Names and units of columns; {} for one value. None: a column for each joint."""
    part: str = ""
    """What a run must have for this quantity: "base", a floating one, "tool", "plan", or an option that
    lists links, each with a row.
    """
    links: tuple[str, ...] | None = None
    """Names of the links of that option."""

    def shape(self, joints: tuple[int, ...]) -> tuple[int, ...]:
        """Return the shape of this quantity where that of a quantity per joint is ``joints`` (...,
        envs, dof).
        """
        if self.columns is None:
            return joints
        # Links stand between the envs and the columns.
        shape = joints[:-1]
        if self.links is not None:
            shape += (len(self.links),)
        if self.columns:
            shape += (len(self.columns),)
        return shape

    def unit_for(self, position: str) -> str:
        """Return the unit for a joint whose position is in ``position``, "rad" or "m"."""
        rotational, _, linear = self.unit.partition("|")
        if linear and position == "m":
            return linear
        return rotational


class Observation(NamedTuple):
    """State of every env after a tick, (envs, dof) in the robot's joint order; ``ok`` is (envs,).

    ``effort``, ``saturated`` and ``guarded`` are from the last sim step; under control "drive" the
    effort is qf alone, since PhysX does not report drive efforts. ``ok`` is False for an env that
    failed in this tick (by its state, its command or its controller), or is suspended since an earlier
    one: see :attr:`batchpid.sim.Runner.faults`. ``tool_pose`` (envs, 7) is the pose of the tool at ``qpos``,
    where setpoints are poses: position [m] and unit quaternion (w, x, y, z); else None.

    ``base_pose`` (envs, 7) is the pose of the robot's root link in the world, where the base
    floats, and ``base_twist`` (envs, 6) the velocity of that link's origin and its angular velocity
    [m/s, rad/s], along the axes of the world; else None.

    ``starved`` (envs,) is the number of sim steps since the reset for which a plan had no row
    ahead; None without a plan.

    ``contact_force`` (envs, links, 3) is the net force of all contacts on each link of the option
    ``contacts`` [N], along the axes of the world, as the mean over the sim steps of the tick, and
    ``touching`` (envs, links) whether it had a contact in one of them; in SAPIEN both are of the
    normal forces in the last sim step. ``wrench`` (envs, links, 6) is the mean force and torque
    that its parent exerts on each link of the option ``wrenches`` [N, N m], at the origin and along
    the axes of the link's frame. They are 0 after a reset, and None without these options.
    """

    qpos: Annotated[Float32, Quantity(np.float32, "joint position", "rad|m")]
    qvel: Annotated[Float32, Quantity(np.float32, "joint velocity", "rad/s|m/s")]
    effort: Annotated[Float32, Quantity(np.float32, "applied joint effort", "N m|N")]
    saturated: Annotated[Bool, Quantity(np.bool_, "effort at its limit")]
    ok: Annotated[Bool, Quantity(np.bool_, "state is finite", columns={})]
    guarded: Annotated[Bool, Quantity(np.bool_, "setpoint changed by the guard")]
    tool_pose: Annotated[
        Float32 | None, Quantity(np.float32, "pose of the tool", "m|1", POSE_UNITS, "tool")
    ] = None
    base_pose: Annotated[
        Float32 | None, Quantity(np.float32, "pose of the base", "m|1", POSE_UNITS, "base")
    ] = None
    base_twist: Annotated[
        Float32 | None, Quantity(np.float32, "twist of the base", "m/s|rad/s", TWIST_UNITS, "base")
    ] = None
    starved: Annotated[
        Float32 | None, Quantity(np.float32, "sim steps without a row ahead", "1", {}, "plan")
    ] = None
    contact_force: Annotated[
        Float32 | None,
        Quantity(np.float32, "contact force on the link", "N", FORCE_UNITS, "contacts"),
    ] = None
    touching: Annotated[
        Bool | None, Quantity(np.bool_, "link had a contact", "1", {}, "contacts")
    ] = None
    wrench: Annotated[
        Float32 | None,
        Quantity(np.float32, "wrench of the parent on the link", "N|N m", WRENCH_UNITS, "wrenches"),
    ] = None

    def for_envs(self, envs: slice | int | Rows | Sequence[int]) -> Observation:
        """Return the observation of some envs (a slice or an index array)."""
        return self.map(itemgetter(envs))

    def map(self, function: Callable[[Rows], Rows]) -> Observation:
        """Return an observation with ``function`` applied to each array that there is."""
        return Observation._make([None if rows is None else function(rows) for rows in self])

    @staticmethod
    def join(parts: Sequence[Observation]) -> Observation:
        """Return the observations as one, along the first axis."""
        columns = zip(*parts, strict=True)
        return Observation._make(
            [None if arrays[0] is None else np.concatenate(arrays) for arrays in columns]
        )

    def __repr__(self) -> str:
        envs, dof = self.qpos.shape[-2:]
        return f"Observation({envs} envs, {dof} joints, {failed_envs(self.ok)})"


_HINTS = get_type_hints(Observation, include_extras=True)
QUANTITIES: dict[str, Quantity] = {name: hint.__metadata__[0] for name, hint in _HINTS.items()}
"""Quantity of each field of :class:`Observation`."""


def observed(
    fixed_base: bool | None = None,
    tool: str | None = None,
    plan: str | None = None,
    **links: tuple[str, ...] | None,
) -> dict[str, Quantity]:
    """Return the quantities of a run, by name; ``links`` are the options that list some."""
    parts = {
        "": True,
        "base": fixed_base is False,
        "tool": tool is not None,
        "plan": plan is not None,
    }
    present = {}
    for name, quantity in QUANTITIES.items():
        rows = links.get(quantity.part)
        if rows or parts.get(quantity.part):
            present[name] = quantity._replace(links=rows)
    return present


OBSERVED = observed()
"""Quantities of every run."""


def empty_observation(*shape: int, observed: Mapping[str, Quantity]) -> Observation:
    """Return unset arrays for observations of ``shape`` (..., envs, dof)."""
    rows: dict[str, Rows] = {}
    for name, quantity in observed.items():
        rows[name] = np.empty(quantity.shape(shape), quantity.dtype)
    return Observation(**rows)


def untouched(num_envs: int, observed: Mapping[str, Quantity]) -> dict[str, Rows]:
    """Return the quantities of links in ``observed`` before the first tick, 0."""
    rows: dict[str, Rows] = {}
    for name, quantity in observed.items():
        if quantity.links:
            rows[name] = np.zeros(quantity.shape((num_envs, 0)), quantity.dtype)
    return rows


def failed_envs(ok: Bool) -> str:
    """Return in words how many envs failed in ``ok`` (..., envs)."""
    # Rows are ticks: an env that failed in one of them counts once.
    failed = (~np.atleast_2d(ok)).any(0).sum()
    if failed:
        return f"{failed} failed"
    return "all ok"
