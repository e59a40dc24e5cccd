"""Options of a runner, checked: one record for :class:`batchpid.sim.Runner`, its loops, snapshots
and recordings.

A group checks its options by themselves and for the robot. Here are the checks of options that
depend on options of another group, or on the number of envs.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Annotated, Any, Concatenate, ParamSpec, get_type_hints

import batchpid as bp
from batchpid.arrays.array_types import Document, Kind, PerMassMatrix
from batchpid.arrays.field_tables import Field, declared, plain
from batchpid.arrays.records import frozen
from batchpid.arrays.trees import digest
from batchpid.checks import AxisKind, instance
from batchpid.errors import InvalidArgumentError, RobotError
from batchpid.law.computed_torque import check_gain_units
from batchpid.law.state import check_drive
from batchpid.sim.description.tables import MjcfFile
from batchpid.sim.engine.scene_spec import SceneSpec
from batchpid.sim.options.groups import (
    Controller,
    ControlMode,
    ControlOptions,
    Option,
    Place,
    SceneOptions,
    WorkerOptions,
    option,
)
from batchpid.sim.randomization.checks import check_params, prepared_actuators
from batchpid.sim.robot.robot import Robot
from batchpid.sim.robot.robot_options import (
    describe,
    fit_actuators,
    fit_guard,
    known_joints,
    scene_of,
    tuned_file,
)
from batchpid.sim.signals import (
    CommandSpec,
    Quantity,
    joint_command,
    observed,
    own_command,
)
from batchpid.sim.tool_space import OperationalSpace

P = ParamSpec("P")
IDEAL = bp.Actuators()
"""Actuators without any effect."""
OPTION_GROUPS = (SceneOptions, ControlOptions, WorkerOptions)


@dataclass(
    frozen=True,
    eq=False,
    kw_only=True,
)
class RunnerKeywords(WorkerOptions, SceneOptions, ControlOptions):
    """Arguments of a :class:`batchpid.sim.Runner`, as they are passed; all but the first two may be
    left out.

    A snapshot and the runner that restores it must agree in the options that snapshots keep.
    """

    robot: Annotated[Robot, option("snapshot")] = field(kw_only=False)
    """From :meth:`batchpid.sim.Robot.load`."""
    num_envs: Annotated[int, Field(low=1, high=1_000_000), option("snapshot")] = field(
        kw_only=False
    )
    """Number of robots, one in each scene."""


def with_arguments_of(
    record: Callable[P, object],
) -> Callable[[Callable[..., None]], Callable[Concatenate[Any, P], None]]:
    """Return a decorator that gives a method the arguments of ``record``, for editors and help."""

    def decorated(method: Callable[..., None]) -> Callable[Concatenate[Any, P], None]:
        kinds = get_type_hints(record)
        this = inspect.Parameter("self", inspect.Parameter.POSITIONAL_OR_KEYWORD)
        parameters = [
            parameter.replace(annotation=kinds[parameter.name])
            for parameter in inspect.signature(record).parameters.values()
        ]
        vars(method)["__signature__"] = inspect.Signature([this, *parameters])
        return method

    return decorated


OPTIONS = declared(RunnerKeywords, Option)
"""Where each argument is kept and shown."""
OPTION_TYPES: dict[str, Kind] = get_type_hints(RunnerKeywords, include_extras=True)
"""Declared type of each argument, with its bounds."""


class RunnerOptions(RunnerKeywords):
    """Options of a :class:`batchpid.sim.Runner`, checked, copied, and with a value for each
    default. Immutable.

    Arguments and attributes are the same as in :class:`RunnerKeywords`; the attributes below have a
    narrower type. ``workers`` is None on a cluster, ``tool`` unless setpoints are poses, and
    ``actuators`` if every effect is off.

    Raises
    ------
    InvalidArgumentError
        An option is out of range.
    """

    params: bp.PIDParams
    control: ControlMode | Controller
    ground: bool
    contacts: tuple[str, ...] | None
    wrenches: tuple[str, ...] | None
    guard: bp.Guard | None
    actuators: bp.Actuators | None

    def __post_init__(self) -> None:
        values = vars(self)
        values["num_envs"] = checked_option("num_envs", self.num_envs)
        remedy = "load one with Robot.load('panda') or a URDF path"
        robot = instance("robot", self.robot, Robot, remedy)
        for group in OPTION_GROUPS:
            options = group(**{entry.name: values[entry.name] for entry in fields(group)})
            values.update(vars(options.fit(robot)))
        # What follows takes options of several groups, in an order in which each is fitted once.
        if isinstance(self.control, OperationalSpace):
            self._check_tree("control", self.control, "control the joints")
            values["control"] = self.control.in_runner(self.timestep, self.compensate)
        values["guard"] = fit_guard(
            self.guard, robot.joints, self.num_envs, self.control_name, self.sets_positions
        )
        values["plan"] = self._checked_plan()
        values["actuators"] = self.check_actuators(self.actuators)
        if self.params is None:
            values["params"] = default_params(robot, self.control, self.loops)
        values["params"] = self.check_params(self.params)
        if refusals := list(self.load_engine().refusals(self.scene)):
            raise RobotError(f"{robot.path}: {'; '.join(map(str, refusals))}")

    @cached_property
    def scene(self) -> SceneSpec:
        """Description of the scenes, for the engine."""
        options = self.values_for("scene")
        drives = self.control == "drive"
        return scene_of(self.robot, mjcf=self.mjcf, drives=drives, **options)

    def _check_tree(self, argument: str, value: object, remedy: str) -> None:
        """Raise InvalidArgumentError for an option that needs a kinematic tree, if the robot has
        closed loops.
        """
        if self.loops:
            names = ", ".join(self.loops)
            problem = f"needs a kinematic tree, and {names} of the file closes a loop of links"
            raise InvalidArgumentError(argument, problem, value=value, remedy=remedy)

    def _checked_plan(self) -> bp.Plan | None:
        """Return the plan, as a read-only copy, if it fits the robot and the control."""
        if self.plan is None:
            if self.randomization is not None and self.randomization.latency is not None:
                problem = "is that of a plan's chunks, and the runner has no plan"
                raise InvalidArgumentError("latency", problem, remedy="give plan=, or leave it out")
            return None
        if not self.sets_positions:
            problem = "makes positions of joints, which this control does not take"
            remedy = "use control 'pid' or 'drive'"
            raise InvalidArgumentError("plan", problem, value=self.control_name, remedy=remedy)
        plan = instance("plan", self.plan, bp.Plan, "build it with make_plan")
        plan.check(self.num_envs, self.robot.joint_names)
        return frozen(plan)

    @property
    def mjcf(self) -> MjcfFile | None:
        """MJCF file that the engine simulates as it is; None for others, and in SAPIEN."""
        return self.file_of(self.robot)

    @property
    def loops(self) -> tuple[str, ...]:
        """Equality constraints that close loops of the simulated robot's links."""
        if self.mjcf is None:
            return ()
        return self.mjcf.loops

    @cached_property
    def observed(self) -> dict[str, Quantity]:
        """Quantities that the loop observes."""
        return observed(
            self.robot.fixed_base,
            contacts=self.contacts,
            plan=self.plan_blend,
            wrenches=self.wrenches,
        )

    @cached_property
    def own_command(self) -> CommandSpec | None:
        """Command that a :class:`Controller` declares; None for commands of joints."""
        return own_command(self.control)

    @cached_property
    def command(self) -> CommandSpec:
        """Names and units of the setpoint's entries."""
        robot = self.robot
        return self.own_command or joint_command(robot.joint_names, robot.units, self.control)

    @cached_property
    def command_columns(self) -> tuple[tuple[AxisKind, tuple[str, ...]], ...]:
        """Last axis of each array of a command: the kind of its columns, and their names."""
        kind: AxisKind = "joint" if self.own_command is None else "entry"
        return (*[(kind, self.command.names)] * 3, ("joint", self.robot.joint_names))

    def check_params(self, params: bp.PIDParams) -> bp.PIDParams:
        """Return ``params``, as a read-only copy, if they fit the robot, the number of envs and the
        control.

        Raises
        ------
        InvalidArgumentError
            They do not fit.
        """
        robot = self.robot
        instance("params", params, bp.PIDParams, "build them with robot.params() or make_params()")
        # Units of gains are a matter of the law, which other controls do not have.
        if params.gain_units is not None and self.control != "pid":
            problem = f"have no meaning under control {self.control_name!r}"
            remedy = "use control 'pid', or params with gain_units 'effort'"
            raise InvalidArgumentError("gain_units", problem, remedy=remedy)
        if isinstance(params.gain_units, PerMassMatrix):
            self._check_tree("gain_units", "mass_matrix", 'use robot.designed("effort")')
        check_gain_units(params)
        if self.control == "drive":
            check_drive(params)
        params.check(self.num_envs, robot.joint_names)
        if self.randomization is not None:
            check_params(self.randomization, params, robot)
        return frozen(params)

    def check_actuators(self, actuators: bp.Actuators | None) -> bp.Actuators | None:
        """Return ``actuators`` as :func:`batchpid.sim.robot.robot_options.fit_actuators` does;
        None if every effect is off.

        None selects the robot's own actuators; control "drive" uses only their friction and
        armature.

        Raises
        ------
        InvalidArgumentError
            They do not fit.
        """
        # The engine's drive replaces the motors' electronics, and not what is behind the gear.
        if actuators is None:
            actuators = self.robot.actuators or IDEAL
            if self.control == "drive":
                actuators = actuators.joint_side()
        fitted: bp.Actuators | None = fit_actuators(
            actuators, self.robot, self.num_envs, self.control
        )
        # Actuators without effect cost time in every sim step.
        if fitted is not None and fitted.is_ideal:
            fitted = None
        if self.randomization is not None:
            fitted = prepared_actuators(self.randomization, fitted, self.robot, self.control)
        if fitted is None:
            return None
        return frozen(fitted)

    def values_for(self, place: Place) -> Document:
        """Return the options that are marked with ``place``, by name.

        - "snapshot": values that two runners must share to restore each other's snapshots;
        - "recording": fields of :class:`batchpid.sim.RunInfo`;
        - "scene": fields of :class:`batchpid.sim.engine.scene_spec.SceneSpec`.
        """
        values = {}
        for name, entry in OPTIONS.items():
            if place in entry.places:
                values[name] = getattr(self, entry.places[place] or name)
        # A recording is read without the classes of the engine and of the randomization.
        if place == "recording":
            values["physics"] = str(self.physics)
            if self.randomization is not None:
                values["randomization"] = repr(self.randomization)
        return values

    @cached_property
    def described(self) -> Document:
        """Robot and options that two runners must share to restore each other's snapshots, as plain
        values.
        """
        robot = self.robot
        command = self.own_command
        options = {name: _plain(value) for name, value in self.values_for("snapshot").items()}
        return options | {
            **describe(robot),
            "joints": list(robot.joint_names),
            "ignored_pairs": digest(robot.self_contact.ignored),
            "robot_actuators": digest(known_joints(robot)),
            "command": None if command is None else list(command.names),
        }


def default_params(
    robot: Robot, control: ControlMode | Controller = "pid", loops: tuple[str, ...] = ()
) -> bp.PIDParams:
    """Return the params of a runner that is given none.

    - ``"pid"``: ``robot.tuned()`` where the robot ships them, else ``robot.designed()``, or with
      closed ``loops`` ``robot.designed("effort")``;
    - ``"drive"``: the drive gains of a bundled robot's settings, else the gains of
      ``robot.designed("effort")`` without ki, setpoint weight and filter, which a drive does not
      have: the integral would overshoot;
    - ``"effort"``, and a :class:`Controller`: zero gains and the robot's effort limits.

    Raises
    ------
    InvalidArgumentError
        The robot ships no gains and none can be designed: its mass matrix is not positive definite.
    """
    # Other controls need the effort limits alone.
    if control not in ("pid", "drive"):
        return robot.params(
            kp=0.0,
            ki=0.0,
            kd=0.0,
        )
    settings = robot.settings
    if control == "drive":
        if settings is None:
            return robot.designed("effort").replace(
                ki=0.0,
                setpoint_weight=None,
                derivative_filter_time=None,
            )
        return robot.params(
            kp=settings.drive_stiffness,
            ki=0.0,
            kd=settings.drive_damping,
            effort_limit=None,
        )
    if tuned_file(robot) is not None:
        return robot.tuned()
    return robot.designed("effort" if loops else None)


def checked_option(name: str, value: object) -> Any:
    """Return the value of an argument in the canonical form of its declared type.

    Raises InvalidArgumentError if a number is out of bounds, or the value is of another type.
    """
    return plain(name, OPTION_TYPES[name], value)


def _plain(value: Any) -> object:
    """Return the value of an option in JSON's types, equal for options that are equal.

    A controller or a function counts by its name and its attribute ``version``, other objects by
    their digest.
    """
    if callable(value):
        name = getattr(value, "__qualname__", type(value).__qualname__)
        return f"{name} {getattr(value, 'version', '')}"
    if type(value) is tuple:
        return list(map(_plain, value))
    if value is None or isinstance(value, str | int | float):
        return value
    if isinstance(value, Robot):
        return value.name
    return digest(value)
