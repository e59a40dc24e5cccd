"""Rollouts: the arrays of a run, and the info of its robot, options and origin."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Float64, Rows
from batchpid.errors import InvalidArgumentError
from batchpid.law.params import PIDParams
from batchpid.motors import Actuators
from batchpid.sim.diagnosis.causes import unsettled_findings
from batchpid.sim.findings import Findings
from batchpid.sim.robot.robot import Robot
from batchpid.sim.signals import (
    QUANTITIES,
    CommandSpec,
    Observation,
    Quantity,
    failed_envs,
    joint_command,
    observed,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RECORDED = {
    "setpoint": Quantity(np.float64, "setpoint", "rad|m"),
    "feedforward": Quantity(np.float64, "effort added before saturation", "N m|N"),
    "changes": Quantity(np.uint8, "reset 1, restore 2, params 4", columns={}),
} | QUANTITIES
"""Quantity of each array of a :class:`Rollout`, ``time`` aside."""
OPTIONAL = ("feedforward", "changes")
"""Arrays of a :class:`Rollout` that may be None."""


RESET, RESTORE, PARAMS = 1, 2, 4
"""Bits of :attr:`Rollout.changes`: the envs were reset, a snapshot was restored, params were
assigned.
"""
_OF_ROBOT = (
    "joint_names",
    "units",
    "lower",
    "upper",
    "effort_limit",
    "fixed_base",
)
"""Fields of :class:`RunInfo` that are attributes of a robot."""
_OF_ENVS = ("params", "actuators", "start", "episodes")  # fields with a row for each env


@dataclass(frozen=True, eq=False)
class RunInfo:
    """Robot, options and origin of a run; None where unknown.

    :meth:`batchpid.sim.Runner.rollout` and :func:`batchpid.sim.read_recording` fill it;
    :meth:`of` makes one by hand.
    """

    robot: str
    """Name of the robot."""
    joint_names: tuple[str, ...]
    units: tuple[str, ...]
    """Unit of each joint's position: "rad" or "m"."""
    lower: Float64
    """Lower position limits (joints,) [rad or m]."""
    upper: Float64
    """Upper position limits (joints,) [rad or m]."""
    effort_limit: Float64
    """Effort limits (joints,) [N m or N]."""
    digest: str | None = None
    """Digest of the robot's bodies, joints and shapes."""
    dissipation: str | None = None
    """Source of joint friction and damping: "urdf" or "sapien"."""
    fixed_base: bool | None = None
    """False if the base floats."""
    timestep: float | None = None
    """Time step of simulation and control [s]."""
    substeps: int | None = None
    """Sim steps of a tick."""
    control: str | None = None
    """One of "pid", "drive", "effort"; of the caller's own controller the name of its class."""
    tool: str | None = None
    """Link of the tool that setpoints move; None where they are not poses."""
    own_command: CommandSpec | None = None
    """Names and units of setpoints that are not one number for each joint."""
    plan: str | None = None
    """Blend of the plan that made setpoints of chunks, whose last rows are recorded; None without
    a plan.
    """
    compensate: str | None = None
    """Efforts added by the runner: "gravity+coriolis+friction", "gravity+coriolis", "gravity" or
    "none".
    """
    engine: str | None = None
    """Physics engine: "sapien" or "mujoco"."""
    physics: str | None = None
    """Solver settings: "accurate", "fast", or the text of a :class:`batchpid.sim.Physics`."""
    collisions: bool | None = None
    """False if the robots had no collision shapes."""
    ground: bool | None = None
    """True if the scenes had a ground at height 0."""
    contacts: tuple[str, ...] | None = None
    """Links whose contact forces were observed."""
    wrenches: tuple[str, ...] | None = None
    """Links with a wrench sensor."""
    rates: bool | None = None
    """True if setpoints were given with rates, and moved within the ticks; None if unknown.
    """
    params: PIDParams | None = None
    """PID parameters at the start."""
    actuators: Actuators | None = None
    """Motors and sensors at the start, before draws of a randomization; None for ideal ones."""
    start: Rows | None = None
    """Positions before the first tick (envs, joints) [rad or m]."""
    versions: Mapping[str, str] | None = None
    """Versions of the packages that results depend on, by name."""
    begun: str | None = None
    """Local date and time of the start, ISO 8601."""
    faults: tuple[Any, ...] = ()
    """Faults (:class:`batchpid.sim.Fault`) of the runner up to the end of the run."""
    randomization: str | None = None
    """Text of the :class:`batchpid.sim.Randomization`."""
    draws: Mapping[str, Float64] | None = None
    """Draws at the start, by field: (envs, joints or links)."""
    episodes: NDArray[np.int64] | None = None
    """Stream and episode of each env at the start (envs, 2)."""
    description: Robot | None = field(default=None, repr=False)
    """Robot (:class:`batchpid.sim.Robot`) of the run, for :meth:`Rollout.findings`; a recording
    keeps its :attr:`urdf` instead.
    """
    urdf: str | None = field(default=None, repr=False)
    """Robot of a recording, as :func:`batchpid.sim.to_urdf` writes it, to be drawn."""

    @classmethod
    def of(cls, robot: Robot, **options: Any) -> RunInfo:
        """Return the info of a run of a :class:`batchpid.sim.Robot`; ``options`` are further
        fields.
        """
        from batchpid.sim.robot.robot_options import content

        values = {name: getattr(robot, name) for name in _OF_ROBOT}
        values |= {"digest": content(robot), "dissipation": robot.source.dissipation}
        return cls(
            robot=robot.name,
            description=robot,
            **values,
            **options,
        )

    @property
    def command(self) -> CommandSpec:
        """Names and units of the setpoint's entries."""
        return self.own_command or joint_command(self.joint_names, self.units, self.control)

    @property
    def sets_positions(self) -> bool:
        """True if setpoints are joint positions."""
        command = self.own_command
        if command is None:
            return self.control != "effort"
        # A controller may declare the joints by name.
        return (command.names, command.units) == (self.joint_names, self.units)

    @property
    def recorded(self) -> dict[str, Quantity]:
        """Quantities of :data:`RECORDED` that this run has."""
        links = {"contacts": self.contacts, "wrenches": self.wrenches}
        commands = {name: RECORDED[name] for name in ("setpoint", *OPTIONAL)}
        return commands | observed(self.fixed_base, self.tool, self.plan, **links)

    def units_of(self, name: str) -> tuple[str, ...]:
        """Return the unit of each column of the quantity ``name`` of :data:`RECORDED`; none if it
        has no columns.
        """
        quantity = RECORDED[name]
        if name == "setpoint":
            return self.command.units
        if quantity.columns is None:
            return tuple(map(quantity.unit_for, self.units))
        return tuple(quantity.columns.values())

    def row_shape(self, name: str, num_envs: int) -> tuple[int, ...]:
        """Return the shape of the quantity ``name`` of :attr:`recorded` after a tick: (envs,
        columns) or (envs,).

        A quantity of links has their number in between.
        """
        return self.recorded[name].shape((num_envs, len(self.units_of(name))))

    def for_envs(self, envs: NDArray[np.int64]) -> RunInfo:
        """Return the info of the envs with these numbers."""

        def rows(value: Any) -> Any:
            if isinstance(value, PIDParams | Actuators):
                return value.for_envs(envs)
            if value is None:
                return None
            return value[envs]

        faults = []
        for fault in self.faults:
            numbers = np.flatnonzero(envs == fault.env).tolist()
            faults += [fault._replace(env=number) for number in numbers]
        draws = self.draws
        if draws is not None:
            draws = {name: rows(table) for name, table in draws.items()}
        tables = {name: rows(getattr(self, name)) for name in _OF_ENVS}
        return replace(
            self,
            draws=draws,
            faults=tuple(faults),
            **tables,
        )

    def __repr__(self) -> str:
        if self.control:
            control = f", control {self.control!r}"
        else:
            control = ""
        return f"RunInfo({self.robot}, {len(self.joint_names)} joints{control})"


@dataclass(frozen=True, eq=False)
class Rollout:
    """Record of a run. Row k is the state at the end of tick k, at ``time[k]``.

    The fields of :class:`Observation` are attributes, with the ticks first: ``qpos`` (ticks, envs,
    dof), ..., ``ok`` (ticks, envs).
    """

    time: Float64
    """End of each tick (ticks,) [s], since the start of the runner; a reset does not set it
    back.
    """
    setpoint: Float64
    """(ticks, envs, dof) [rad or m]; under control "effort" the commanded effort [N m or N]. For a
    control that defines its command (ticks, envs, size), in the order of ``info.command.names``.
    """
    observation: Observation
    """Observations, stacked."""
    tick: float
    """Time from one row to the next [s]."""
    info: RunInfo
    """Robot, options and origin of the run."""
    feedforward: Float64 | None = None
    """Joint efforts added before saturation (ticks, envs, dof) [N m or N]; None if none were
    given.
    """
    changes: Rows | None = None
    """Changes of each env between the tick before and this one (ticks, envs) uint8, as a sum: 1
    for a reset, 2 for a restored snapshot, 4 for other params, 8 for other actuators; None if there
    were none.
    """

    def __getattr__(self, name: str) -> Rows:
        if name not in QUANTITIES:
            # Only names that are no fields come here.
            names = ", ".join(QUANTITIES)
            raise AttributeError(
                f"a Rollout has no {name!r}; it has time, setpoint, tick, info, {names}"
            )
        array: Rows = getattr(self.observation, name)
        return array

    @property
    def num_envs(self) -> int:
        """Number of envs."""
        return int(self.qpos.shape[1])

    def arrays(self) -> dict[str, Rows]:
        """Return time, setpoint, feedforward and changes if there are any, and every quantity that
        was observed, by name.
        """
        seen = {
            name: array for name, array in self.observation._asdict().items() if array is not None
        }
        for name in OPTIONAL:
            if getattr(self, name) is not None:
                seen[name] = getattr(self, name)
        return {"time": self.time, "setpoint": self.setpoint, **seen}

    def for_envs(self, envs: slice | Sequence[int] | Rows) -> Rollout:
        """Return the rollout of some envs (a slice or an index array)."""
        numbers = np.arange(self.num_envs)[envs]
        return self._mapped(lambda array: array[:, numbers], info=self.info.for_envs(numbers))

    def for_ticks(self, start: int, stop: int | None = None) -> Rollout:
        """Return the rollout of the ticks from ``start`` to ``stop``, as in a slice.

        Of a later part, the info has the state of envs at its start where the run shows it.
        """
        part = slice(start, stop)
        first, *_ = part.indices(len(self.time))
        time = self.time[part]
        changes = self.changes
        faults = [fault for fault in self.info.faults if len(time) and fault.time <= time[-1]]
        info = replace(self.info, faults=tuple(faults))
        if first:
            # A later part starts where the ticks before it ended, if no env was placed in between.
            before = np.zeros(1, np.uint8) if changes is None else changes[1 : first + 1]
            is_placed = (before[-1:] & (RESET | RESTORE)).any()
            info = replace(info, start=None if is_placed else self.qpos[first - 1])
            if before.any():
                info = replace(
                    info,
                    params=None,
                    actuators=None,
                    draws=None,
                    episodes=None,
                )
        return self._mapped(itemgetter(part), time=time, info=info)

    def _mapped(self, function: Callable[[Rows], Rows], **others: Any) -> Rollout:
        """Return a rollout with ``function`` applied to each array but the times, and with other
        fields.
        """
        for name in OPTIONAL:
            rows = getattr(self, name)
            others[name] = None if rows is None else function(rows)
        setpoint = function(self.setpoint)
        seen = self.observation.map(function)
        return replace(
            self,
            setpoint=setpoint,
            observation=seen,
            **others,
        )

    @staticmethod
    def join(parts: Sequence[Rollout]) -> Rollout:
        """Return successive rollouts of a runner as one, with the info of the first and the faults
        of the last, which include the earlier ones.

        Raises InvalidArgumentError for parts of other robots, envs or ticks, or that do not
        follow each other.
        """
        first = parts[0]
        time = np.concatenate([part.time for part in parts])
        kinds = {
            (part.info.digest, part.info.joint_names, part.num_envs, part.tick) for part in parts
        }
        if len(kinds) > 1 or (np.abs(np.diff(time) - first.tick) > 1e-6 * first.tick).any():
            problem = "are of other robots, envs or ticks, or do not follow each other"
            remedy = "join the rollouts of one run, in their order"
            raise InvalidArgumentError("parts", problem, remedy=remedy)
        joined: dict[str, Any] = {}
        for name in OPTIONAL:
            tables = [getattr(part, name) for part in parts]
            present = [table for table in tables if table is not None]
            # A part without feedforward or changes has 0.
            if present:
                zero = np.zeros_like(present[0][:1])
                for number, part in enumerate(parts):
                    if tables[number] is None:
                        tables[number] = np.repeat(zero, len(part.time), axis=0)
                joined[name] = np.concatenate(tables)
        return replace(
            first,
            time=time,
            setpoint=np.concatenate([part.setpoint for part in parts]),
            observation=Observation.join([part.observation for part in parts]),
            info=replace(
                first.info,
                faults=parts[-1].info.faults,
                rates=any(part.info.rates for part in parts),
            ),
            **joined,
        )

    def __repr__(self) -> str:
        ticks, envs, dof = self.qpos.shape
        if ticks:
            end = f"up to {self.time[-1]:g} s"
        else:
            end = "empty"
        return f"Rollout({ticks} ticks {end}, {envs} envs, {dof} joints, {failed_envs(self.ok)})"

    def findings(self, robot: Robot | None = None) -> Findings:
        """Return the causes for which joints do not settle; an empty list if all settle.

        Each is a :class:`batchpid.sim.Finding` with ``code``, ``text``, ``remedy``, ``envs``,
        ``time`` [s], and a joint or a detail.

        Parameters
        ----------
        robot
            Robot of the run, a :class:`batchpid.sim.Robot`; needed for a recording, which does not
            hold its meshes.

        Raises
        ------
        InvalidArgumentError
            The robot is not known, or has other joints than the run.
        """
        if robot is None:
            robot = self.info.description
        if robot is None:
            problem = "is unknown for this run"
            remedy = "pass it: rollout.findings(Robot.load(...))"
            raise InvalidArgumentError("robot", problem, remedy=remedy)
        return unsettled_findings(self, robot)

    def check_ticks(self) -> None:
        """Raise InvalidArgumentError if the run holds no tick, so that nothing can be shown."""
        if not len(self.time):
            remedy = "run it for a tick or more"
            raise InvalidArgumentError("rollout", "holds no tick", remedy=remedy)

    def plot(self, **options: Any) -> Figure:
        """Return a Matplotlib figure of the run, which a notebook shows: positions above efforts
        for each joint.

        ``options`` are arguments of :func:`batchpid.sim.plots.step_responses`: joints, title.
        """
        from batchpid.sim.plots import step_responses

        return step_responses(self, **options)
