"""Observations, and rollouts with the info of their run. A new quantity that the loop observes is
one line here.

Longer than 350 lines because the two share their fields, and document each with shape and unit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from operator import itemgetter
from types import MappingProxyType
from typing import Annotated, Any, NamedTuple, get_type_hints

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Bool, DType, Float32, Float64, Rows
from batchpid.errors import InvalidArgumentError
from batchpid.law.params import PIDParams
from batchpid.motors import Actuators
from batchpid.sim.signals.command import (
    FORCE_UNITS,
    POSE_UNITS,
    TWIST_UNITS,
    WRENCH_UNITS,
    CommandSpec,
    joint_command,
)


class Quantity(NamedTuple):
    """Observed quantity: its dtype, meaning, unit ("rad|m" is the joint's own), and whether there
    is one per joint.

    If not, ``columns`` are names and units of its columns, if it has any. ``option`` is the option
    of a runner that lists links, with a row for each; ``links`` are these links.
    """

    dtype: DType
    meaning: str
    unit: str = "1"
    per_joint: bool = True
    columns: Mapping[str, str] = MappingProxyType({})
    option: str = ""
    links: tuple[str, ...] = ()

    def shape(self, joints: tuple[int, ...]) -> tuple[int, ...]:
        """Return the shape of this quantity where that of a quantity per joint is ``joints`` (...,
        envs, dof).
        """
        rows = [len(self.links)] if self.option else []
        return (
            joints
            if self.per_joint
            else (*joints[:-1], *rows, *([len(self.columns)] if self.columns else ()))
        )

    def unit_for(self, position: str) -> str:
        """Return the unit for a joint whose position is in ``position``, "rad" or "m"."""
        rotational, _, linear = self.unit.partition("|")
        return linear if linear and position == "m" else rotational


class Observation(NamedTuple):
    """State of every env after a tick, (envs, dof) in the robot's joint order; ``ok`` is (envs,).

    ``effort``, ``saturated`` and ``guarded`` are from the last sim step; under control "drive" the
    effort is qf alone, since PhysX does not report drive efforts. ``ok`` is False for an env that
    failed in this tick, or that is suspended since an earlier one: see
    :attr:`batchpid.sim.Runner.faults`. ``tool_pose`` (envs, 7) is the pose of the tool at ``qpos``,
    where setpoints are poses: position [m] and unit quaternion (w, x, y, z); else None.

    ``base_pose`` (envs, 7) is the pose of the robot's root link in the world, where the base
    floats, and ``base_twist`` (envs, 6) the velocity of that link's origin and its angular velocity
    [m/s, rad/s], along the axes of the world; else None.

    ``contact_force`` (envs, links, 3) is the net force of all contacts on each link of the option
    ``contacts`` [N], along the axes of the world, as the mean over the sim steps of the tick, and
    ``touching`` (envs, links) whether it had a contact in one of them. ``wrench`` (envs, links, 6)
    is the mean force and torque that its parent exerts on each link of the option ``wrenches`` [N,
    N m], at the origin and along the axes of the link's frame. They are 0 after a reset, and None
    without these options.
    """

    qpos: Annotated[Float32, Quantity(np.float32, "joint position", "rad|m")]
    qvel: Annotated[Float32, Quantity(np.float32, "joint velocity", "rad/s|m/s")]
    effort: Annotated[Float32, Quantity(np.float32, "applied joint effort", "N m|N")]
    saturated: Annotated[Bool, Quantity(np.bool_, "effort at its limit")]
    ok: Annotated[Bool, Quantity(np.bool_, "state is finite", per_joint=False)]
    guarded: Annotated[Bool, Quantity(np.bool_, "setpoint changed by the guard")]
    tool_pose: Annotated[
        Float32 | None, Quantity(np.float32, "pose of the tool", "m|1", False, POSE_UNITS)
    ] = None
    base_pose: Annotated[
        Float32 | None, Quantity(np.float32, "pose of the base", "m|1", False, POSE_UNITS)
    ] = None
    base_twist: Annotated[
        Float32 | None, Quantity(np.float32, "twist of the base", "m/s|rad/s", False, TWIST_UNITS)
    ] = None
    contact_force: Annotated[
        Float32 | None,
        Quantity(np.float32, "contact force on the link", "N", False, FORCE_UNITS, "contacts"),
    ] = None
    touching: Annotated[
        Bool | None, Quantity(np.bool_, "link had a contact", "1", False, option="contacts")
    ] = None
    wrench: Annotated[
        Float32 | None,
        Quantity(
            np.float32, "wrench of the parent on the link", "N|N m", False, WRENCH_UNITS, "wrenches"
        ),
    ] = None

    def for_envs(self, envs: slice | Any) -> Observation:
        """Return the observation of some envs (a slice or an index array)."""
        return self.map(itemgetter(envs))

    def map(self, function: Callable[[Rows], Rows]) -> Observation:
        """Return an observation with ``function`` applied to each array that there is."""
        return Observation._make([None if array is None else function(array) for array in self])

    def copied(self, tool_pose: Callable[[Rows], NDArray[np.float32]] | None = None) -> Observation:
        """Return a copy with arrays of its own; ``tool_pose`` gives the pose of the tool at
        positions (..., dof).
        """
        rows = list[Any]()
        for array in self:  # no comprehension, which is a call of Python in the path of a tick
            rows.append(None if array is None else array.copy())
        if tool_pose is not None:
            rows[_TOOL_POSE] = tool_pose(rows[0])
        return Observation(*rows)

    @staticmethod
    def join(parts: Sequence[Observation]) -> Observation:
        """Return the observations as one, along the first axis."""
        columns = zip(*parts, strict=True)
        return Observation._make(
            [None if arrays[0] is None else np.concatenate(arrays) for arrays in columns]
        )

    def __repr__(self) -> str:
        envs, dof = self.qpos.shape[-2:]
        return f"Observation({envs} envs, {dof} joints, {_failed_envs(self.ok)})"


_TOOL_POSE = Observation._fields.index("tool_pose")
_SEEN = {
    name: hint.__metadata__[0]
    for name, hint in get_type_hints(Observation, include_extras=True).items()
}
OPTIONAL = ("tool_pose", "base_pose", "base_twist", "contact_force", "touching", "wrench")
"""Fields of :class:`Observation` that may be None."""
OBSERVED: dict[str, Quantity] = {
    name: quantity for name, quantity in _SEEN.items() if name not in OPTIONAL
}
"""Quantity of each other field."""
BASE: dict[str, Quantity] = {name: _SEEN[name] for name in ("base_pose", "base_twist")}
"""Quantities of a floating base."""
RECORDED = {
    "setpoint": Quantity(np.float64, "setpoint", "rad|m"),
    "feedforward": Quantity(np.float64, "effort added before saturation", "N m|N"),
} | _SEEN
"""Quantity of each array of a :class:`Rollout`, ``time`` aside."""


def observed_by_loop(
    fixed_base: bool | None, **links: tuple[str, ...] | None
) -> dict[str, Quantity]:
    """Return the quantities that a loop observes, by name.

    These are :data:`OBSERVED`, those of a floating base, and those of ``links``: the options that
    list some.
    """
    found = dict(OBSERVED) if fixed_base is not False else OBSERVED | BASE
    for name, quantity in _SEEN.items():
        if names := links.get(quantity.option):
            found[name] = quantity._replace(links=names)
    return found


def empty_observation(*shape: int, observed: Mapping[str, Quantity] = OBSERVED) -> Observation:
    """Return unset arrays for observations of ``shape`` (..., envs, dof)."""
    rows: dict[str, Rows] = {
        name: np.empty(each.shape(shape), each.dtype) for name, each in observed.items()
    }
    return Observation(**rows)


def untouched(num_envs: int, observed: Mapping[str, Quantity]) -> dict[str, Rows]:
    """Return the quantities of links in ``observed`` before the first tick, 0."""
    return {
        name: np.zeros(each.shape((num_envs, 0)), each.dtype)
        for name, each in observed.items()
        if each.option
    }


class Redraw(NamedTuple):
    """Beginning of an episode during a run: a randomization drew for an env again."""

    time: float
    """End of the first tick [s]."""
    env: int
    stream: int
    episode: int


_OF_ROBOT = (
    *("joint_names", "units", "lower", "upper", "effort_limit"),
    *("digest", "dissipation", "fixed_base"),
)  # fields of RunInfo that are attributes of a robot


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
    compensate: str | None = None
    """Efforts added by the runner: "gravity+coriolis+friction", "gravity+coriolis", "gravity" or
    "none".
    """
    engine: str | None = None
    """Physics engine: "sapien"."""
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
    """True if setpoints were given with rates, and moved within the ticks; None if unknown, as
    after a kill.
    """
    params: PIDParams | None = None
    """PID parameters at the start."""
    params_changed: bool = False
    """True if they were changed in the run, or a snapshot was restored; known of a complete
    recording.
    """
    actuators: Actuators | None = None
    """Motors and sensors at the start, before draws of a randomization; None for ideal ones."""
    start: Rows | None = None
    """Positions before the first tick (envs, joints) [rad or m]."""
    seed: int | None = None
    """Seed of the run."""
    versions: Mapping[str, str] | None = None
    """Versions of the packages that results depend on, by name."""
    begun: str | None = None
    """Local date and time of the start, ISO 8601."""
    complete: bool = True
    """False for a recording that was cut short, or is still being written."""
    faults: tuple[Any, ...] = ()
    """Faults (:class:`batchpid.sim.Fault`) of the runner up to the end of the run."""
    randomization: Mapping[str, Any] | None = None
    """Distributions, as :meth:`batchpid.sim.Randomization.to_dict` returns them."""
    draws: Mapping[str, Float64] | None = None
    """Draws at the start, by field: (envs, joints or links)."""
    episodes: NDArray[np.int64] | None = None
    """Stream and episode of each env at the start (envs, 2)."""
    redraws: tuple[Redraw, ...] = ()
    """Episodes that began after that."""
    description: Any = field(default=None, repr=False)
    """Robot (:class:`batchpid.sim.Robot`) of the run, for :meth:`Rollout.findings`; not
    recorded.
    """
    options: Mapping[str, Any] | None = None
    """Further options of the runner that recordings keep, by name."""

    @classmethod
    def of(cls, robot: Any, **options: Any) -> RunInfo:
        """Return the info of a run of a :class:`batchpid.sim.Robot`; ``options`` are further
        fields.
        """
        values = {name: getattr(robot, name) for name in _OF_ROBOT}
        return cls(robot=robot.name, description=robot, **values, **options)

    @property
    def command(self) -> CommandSpec:
        """Names and units of the setpoint's entries."""
        return self.own_command or joint_command(self.joint_names, self.units, self.control)

    @property
    def sets_positions(self) -> bool:
        """True if setpoints are joint positions."""
        own = self.own_command
        return (
            self.control != "effort"
            if own is None
            else (own.names, own.units) == (self.joint_names, self.units)
        )

    @property
    def recorded(self) -> dict[str, Quantity]:
        """Quantities of :data:`RECORDED` that this run has."""
        seen = observed_by_loop(self.fixed_base, contacts=self.contacts, wrenches=self.wrenches)
        present = {"setpoint", "feedforward", *seen, *(() if self.tool is None else ("tool_pose",))}
        return {name: each for name, each in (RECORDED | seen).items() if name in present}

    def units_of(self, name: str) -> tuple[str, ...]:
        """Return the unit of each column of the quantity ``name`` of :data:`RECORDED`; none if it
        has no columns.
        """
        quantity = RECORDED[name]
        if name == "setpoint":
            return self.command.units
        return (
            tuple(map(quantity.unit_for, self.units))
            if quantity.per_joint
            else tuple(quantity.columns.values())
        )

    def row_shape(self, name: str, num_envs: int) -> tuple[int, ...]:
        """Return the shape of the quantity ``name`` of :attr:`recorded` after a tick: (envs,
        columns) or (envs,).

        A quantity of links has their number in between.
        """
        return self.recorded[name].shape((num_envs, len(self.units_of(name))))

    def for_envs(self, envs: NDArray[np.int64]) -> RunInfo:
        """Return the info of the envs with these numbers."""
        return self._followed(lambda rule, value: rule.for_envs(value, envs))

    def for_ticks(self, start: Rows | None, begin: float, end: float) -> RunInfo:
        """Return the info of the ticks between two times [s], where the first begins at the
        positions ``start``.
        """
        span = TickRange(
            start, begin, end, tuple([redraw for redraw in self.redraws if redraw.time <= begin])
        )
        return self._followed(lambda rule, value: rule.for_ticks(value, span))

    def _followed(self, follow: Callable[[FieldRule, Any], Any]) -> RunInfo:
        values = {name: value for name, value in vars(self).items() if value is not None}
        return replace(self, **{name: follow(RULES[name], value) for name, value in values.items()})

    def __repr__(self) -> str:
        control = f", control {self.control!r}" if self.control else ""
        return f"RunInfo({self.robot}, {len(self.joint_names)} joints{control})"


class TickRange(NamedTuple):
    """Ticks of a run between two times [s]."""

    start: Rows | None
    """Positions before the first tick (envs, dof); None where unknown."""
    begin: float
    end: float
    earlier: tuple[Redraw, ...]
    """Redraws before these ticks."""


class FieldRule(NamedTuple):
    """Effect of :meth:`Rollout.for_envs`, :meth:`Rollout.for_ticks` and :meth:`Rollout.join` on a
    field.

    A field that is None stays None. ``join`` takes the values of all parts; without it they have to
    be equal.
    """

    for_envs: Callable[[Any, NDArray[np.int64]], Any] = lambda value, envs: value
    for_ticks: Callable[[Any, TickRange], Any] = lambda value, span: value
    join: Callable[[Sequence[Any]], Any] | None = None


def _events_of(events: tuple[Any, ...], envs: NDArray[np.int64]) -> tuple[Any, ...]:
    """Return the events of some envs, under their new numbers."""
    renumbered = []
    for event in events:
        renumbered += [
            event._replace(env=number) for number in np.flatnonzero(envs == event.env).tolist()
        ]
    return tuple(renumbered)


def _episodes_at(episodes: NDArray[np.int64], span: TickRange) -> NDArray[np.int64]:
    """Return stream and episode of each env at the start of ``span``."""
    episodes = episodes.copy()
    for redraw in span.earlier:
        episodes[redraw.env] = redraw.stream, redraw.episode
    return episodes


def _joined_rates(values: Sequence[bool | None]) -> bool | None:
    """Return True if a part had rates, None if a part does not say whether it had."""
    return True if True in values else None if None in values else False


_FIRST = itemgetter(0)
RULES: dict[str, FieldRule] = dict.fromkeys(
    (
        *(
            "robot",
            "joint_names",
            "units",
            "lower",
            "upper",
            "effort_limit",
            "digest",
            "dissipation",
        ),
        *(
            "fixed_base",
            "timestep",
            "substeps",
            "control",
            "tool",
            "own_command",
            "compensate",
            "engine",
            "physics",
        ),
        *("collisions", "ground", "contacts", "wrenches", "randomization", "options"),
    ),
    FieldRule(),
)
RULES |= dict.fromkeys(("seed", "versions", "begun", "description"), FieldRule(join=_FIRST))
RULES |= dict.fromkeys(
    ("params", "actuators"), FieldRule(lambda value, envs: value.for_envs(envs), join=_FIRST)
)
RULES |= {
    "start": FieldRule(lambda start, envs: start[envs], lambda start, span: span.start, _FIRST),
    "draws": FieldRule(
        lambda draws, envs: {name: rows[envs] for name, rows in draws.items()},
        lambda draws, span: None if span.earlier else draws,
        _FIRST,
    ),
    "episodes": FieldRule(lambda episodes, envs: episodes[envs], _episodes_at, _FIRST),
    "complete": FieldRule(join=all),
    "params_changed": FieldRule(join=any),
    "rates": FieldRule(join=_joined_rates),
    "faults": FieldRule(
        _events_of,
        lambda faults, span: tuple([fault for fault in faults if fault.time <= span.end]),
        itemgetter(-1),  # faults of a runner include the earlier ones
    ),
    "redraws": FieldRule(
        _events_of,
        lambda redraws, span: tuple(
            [redraw for redraw in redraws if span.begin < redraw.time <= span.end]
        ),
        lambda parts: tuple(dict.fromkeys([redraw for part in parts for redraw in part])),
    ),
}
"""Rule of each field of :class:`RunInfo`."""


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
    """(ticks, envs, dof) [rad or m]; under control "effort" the effort asked for [N m or N]. For a
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

    def __getattr__(self, name: str) -> Rows:
        if name not in _SEEN:
            raise AttributeError(
                f"a Rollout has no {name!r}; it has time, setpoint, tick, info, {', '.join(_SEEN)}"
            )
        array: Rows = getattr(self.observation, name)
        return array

    @property
    def num_envs(self) -> int:
        """Number of envs."""
        return int(self.qpos.shape[1])

    def arrays(self) -> dict[str, Rows]:
        """Return time, setpoint, feedforward if one was given, and every quantity that was
        observed, by name.
        """
        seen = {
            name: array for name, array in self.observation._asdict().items() if array is not None
        }
        if self.feedforward is not None:
            seen["feedforward"] = self.feedforward
        return {"time": self.time, "setpoint": self.setpoint, **seen}

    def for_envs(self, envs: slice | Sequence[int] | Any) -> Rollout:
        """Return the rollout of some envs (a slice or an index array)."""
        numbers = np.arange(self.num_envs)[envs]
        return self._mapped(lambda array: array[:, numbers], info=self.info.for_envs(numbers))

    def for_ticks(self, ticks: slice) -> Rollout:
        """Return the rollout of some ticks."""
        numbers = np.arange(len(self.time))[ticks]
        time, info = self.time[ticks], self.info
        if len(numbers):
            first = numbers[0]
            start, begin = (
                (self.qpos[first - 1], self.time[first - 1]) if first else (info.start, -np.inf)
            )
            info = info.for_ticks(start, float(begin), float(time[-1]))
        return self._mapped(
            itemgetter(ticks), time=time, tick=self.tick * (ticks.step or 1), info=info
        )

    def _mapped(self, function: Callable[[Rows], Rows], **others: Any) -> Rollout:
        """Return a rollout with ``function`` applied to each array but the times, and with other
        fields.
        """
        feedforward = None if self.feedforward is None else function(self.feedforward)
        seen = self.observation.map(function)
        return replace(
            self,
            setpoint=function(self.setpoint),
            observation=seen,
            feedforward=feedforward,
            **others,
        )

    @staticmethod
    def join(parts: Sequence[Rollout]) -> Rollout:
        """Return successive rollouts of one run as one.

        State and origin are those at the start of the first part, faults those at the end of the
        last. It is complete if all parts are, and has rates or feedforwards if one has; if rates of
        others are unknown, so are the whole's.

        Raises InvalidArgumentError if ``parts`` are empty, or differ in the robot, an option, the
        tick or the number of envs.
        """
        if not parts:
            raise InvalidArgumentError("parts", "are empty", remedy="give one rollout or more")
        first = parts[0]
        odd = [
            name
            for name in ("tick", "num_envs")
            if len({getattr(part, name) for part in parts}) > 1
        ]
        joined = {}
        for name, rule in RULES.items():
            values = [getattr(part.info, name) for part in parts]
            if rule.join is not None:
                joined[name] = rule.join(values)
            elif not all(_is_equal(values[0], value) for value in values):
                odd.append(name)
        if odd:
            raise InvalidArgumentError(
                "parts", f"differ in {', '.join(odd)}", remedy="join parts of one run"
            )
        feedforward = None
        if any(part.feedforward is not None for part in parts):
            rows = [
                np.zeros(part.qpos.shape) if part.feedforward is None else part.feedforward
                for part in parts
            ]
            feedforward = np.concatenate(rows)
        return Rollout(
            np.concatenate([part.time for part in parts]),
            np.concatenate([part.setpoint for part in parts]),
            Observation.join([part.observation for part in parts]),
            first.tick,
            replace(first.info, **joined),
            feedforward,
        )

    def __repr__(self) -> str:
        ticks, envs, dof = self.qpos.shape
        end = f"up to {self.time[-1]:g} s" if ticks else "empty"
        return f"Rollout({ticks} ticks {end}, {envs} envs, {dof} joints, {_failed_envs(self.ok)})"

    def findings(self, robot: Any = None) -> Any:
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
        from batchpid.sim.diagnosis.findings import unsettled_findings

        robot = self.info.description if robot is None else robot
        if robot is None:
            problem, remedy = (
                "of this run is not known",
                "pass it: rollout.findings(Robot.load(...))",
            )
            raise InvalidArgumentError("robot", problem, remedy=remedy)
        return unsettled_findings(self, robot)

    def plot(self, **options: Any) -> Any:
        """Return a Matplotlib figure of the run, which a notebook shows: positions above efforts
        for each joint.

        ``options`` are arguments of :func:`batchpid.sim.plots.step_responses`: joints, band, mark,
        title.
        """
        from batchpid.sim.plots import step_responses

        return step_responses(self, **options)


def _is_equal(first: Any, second: Any) -> bool:
    return first is second or bool(
        np.array_equal(first, second) if isinstance(first, np.ndarray) else first == second
    )


def _failed_envs(ok: Bool) -> str:
    failed = int((~ok.reshape(-1, ok.shape[-1]).all(0)).sum()) if ok.size else 0
    return f"{failed} failed" if failed else "all ok"
