"""Options of a runner, checked: one definition for :class:`batchpid.sim.Runner`, its loops,
snapshots and recordings.

Longer than 350 lines because the checks of options that depend on the robot or on each other are
here. A new option is a field of :class:`batchpid.sim.RunnerKeywords`; one that changes scenes is a
field of :class:`batchpid.sim.engine.scene_spec.SceneSpec`, too. CONTRIBUTING.md lists all steps.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Callable
from dataclasses import astuple, fields
from functools import cached_property
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid.arrays.array_types import Document, Rows
from batchpid.arrays.choices import PerMassMatrix
from batchpid.arrays.digest import digest
from batchpid.arrays.jax_settings import require_jax
from batchpid.arrays.read_only import read_only
from batchpid.arrays.records import frozen
from batchpid.checks.validate import AxisKind, choice, instance, joint_speeds, names
from batchpid.errors import InvalidArgumentError
from batchpid.law.computed_torque import check_gain_units
from batchpid.law.input_checks import check_drive
from batchpid.motors.coupling import Coupling
from batchpid.motors.friction import Friction
from batchpid.sim.engine.native import xla
from batchpid.sim.engine.physics import MujocoSolver, Physics
from batchpid.sim.engine.protocol import Capability, Engine, load_engine, require
from batchpid.sim.engine.scene_spec import added_friction
from batchpid.sim.options.keywords import (
    OPTIONS,
    Controller,
    ControlMode,
    Place,
    RunnerKeywords,
    checked_option,
)
from batchpid.sim.options.ray_options import Ray
from batchpid.sim.randomization.checks import check_params, check_robot, prepared_actuators
from batchpid.sim.randomization.randomization import Randomization
from batchpid.sim.robot.actuator_checks import fit_actuators, known_joints
from batchpid.sim.robot.merging import place_links
from batchpid.sim.robot.parts import MjcfFile
from batchpid.sim.robot.robot import Robot
from batchpid.sim.robot.setpoint_limits import fit_guard
from batchpid.sim.signals.command import CommandSpec, joint_command, own_command
from batchpid.sim.signals.observation import Quantity, observed
from batchpid.sim.signals.rollout import RunInfo
from batchpid.sim.tool_space.osc_controller import OperationalSpace, default_tool

IDEAL = bp.Actuators()
"""Actuators without any effect."""


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
    speed_limit: NDArray[np.float64] | None
    guard: bp.Guard | None
    cluster: Ray | None

    def __post_init__(self) -> None:
        super().__post_init__()
        own, given = vars(self), dict(vars(self))
        robot = instance(
            "robot", self.robot, Robot, "load one with Robot.load('panda') or a URDF path"
        )
        own["control"] = _control(self.control, robot, given["tool"])
        if given["ground"] is None:
            own["ground"] = self.collisions and self._has_ground
        if isinstance(self.control, OperationalSpace):
            own["control"], own["tool"] = (
                self.control.in_runner(self.timestep, self.compensate),
                self.control.link,
            )
        own["workers"], own["cluster"] = _places(self.workers, given["cluster"])
        self._check_engine()
        if self.build is not None and not callable(self.build):
            raise InvalidArgumentError(
                "build", "must be a function", value=self.build, remedy="define build(scene, env)"
            )
        if given["speed_limit"] is not None:
            limit = joint_speeds("speed_limit", given["speed_limit"], robot.joint_names)
            own["speed_limit"] = read_only(limit.copy())
        if self.randomization is not None:
            remedy = "pass e.g. Randomization(payload=Uniform(0, 1))"
            check_robot(
                instance("randomization", self.randomization, Randomization, remedy),
                robot,
                self.mjcf,
            )
            self._check_world(self.randomization)
        self._check_tree()
        own["guard"] = fit_guard(
            given["guard"], robot.joints, self.num_envs, self.control_name, self.sets_positions
        )
        if self.backend == "jax":
            self._check_program()
        own["actuators"] = self.check_actuators(given["actuators"])
        self._check_collisions()
        params = (
            default_params(robot, self.control, self.loops)
            if given["params"] is None
            else given["params"]
        )
        own["params"] = self.check_params(params)
        for name in ("contacts", "wrenches"):
            own[name] = self._sensed_links(name, given[name])

    def _check_engine(self) -> None:
        """Raise InvalidArgumentError for options that the physics engine does not have."""
        engine = self.load_engine()
        if not engine.is_physics(self.physics):
            choice("physics", self.physics, engine.physics)
        needed: dict[Capability, tuple[str, bool]] = {
            "drive": ("control", self.control == "drive"),
            "build": ("build", self.build is not None),
            "sapien_dissipation": ("robot", self.robot.dissipation == "sapien"),
        }
        for capability, (argument, needs) in needed.items():
            if needs:
                require(engine, capability, argument)

    def _check_program(self) -> None:
        """Raise InvalidArgumentError for an option that the program of backend "jax" does not
        have.
        """
        require_jax()
        engine, robot = self.load_engine(), self.robot
        whole = "coriolis" in self.compensate or "partial_force" in engine.capabilities
        reads_force = whole and (robot.fixed_base or "base_state" in engine.capabilities)
        reason = f"{engine.title} has no compiled sim steps"
        if "compiled_steps" in engine.capabilities:
            reason = engine.native_obstacle() or xla.obstacle()
        lacking = (
            ("backend", reason, f"is 'jax'; {reason}"),
            ("control", self.control == "drive", "'drive' has no law to compile"),
            ("robot", not robot.coupling.is_identity, "has coupled joints"),
            (
                "robot",
                not robot.fixed_base and robot.friction.any(),
                "has a floating base, and joints with friction",
            ),
            (
                "compensate",
                "gravity" in self.compensate and not reads_force,
                "needs a passive force of NumPy",
            ),
            ("randomization", self.randomization is not None, "is given"),
            ("guard", self.guard is not None, "is given"),
            ("robot", robot.actuators is not None, "has actuators"),
        )
        for argument, lacks, problem in lacking:
            if lacks:
                raise _not_in_program(argument, problem)

    def _check_tree(self) -> None:
        """Raise InvalidArgumentError for options that need a kinematic tree, if the robot has
        closed loops.
        """
        if self.loops and isinstance(self.control, OperationalSpace):
            problem = (
                f"needs a kinematic tree, and {', '.join(self.loops)} of the file closes a loop of"
                " links"
            )
            remedy = "control the joints, or remove the equality constraint"
            raise InvalidArgumentError("control", problem, value=self.control, remedy=remedy)

    @property
    def mjcf(self) -> MjcfFile | None:
        """MJCF file that the engine simulates as it is; None for others, and in SAPIEN."""
        return self.robot.mjcf if self.engine == "mujoco" else None

    @property
    def _has_ground(self) -> bool:
        return (self.mjcf is not None and self.mjcf.has_floor) or self.robot.has_ground

    @property
    def loops(self) -> tuple[str, ...]:
        """Equality constraints that close loops of the simulated robot's links."""
        return () if self.mjcf is None else self.mjcf.loops

    def _check_collisions(self) -> None:
        """Raise InvalidArgumentError for options that have no meaning without collisions."""
        if self.collisions:
            return
        if self.mjcf is not None and self.mjcf.falling:
            problem = (
                f"are False, and nothing holds the bodies {', '.join(self.mjcf.falling)} of the"
                " file"
            )
            raise InvalidArgumentError("collisions", problem, remedy="leave it out")
        if self.ground:
            problem, remedy = (
                "is True, and collisions are False",
                "leave it out: nothing can touch a ground",
            )
            raise InvalidArgumentError("ground", problem, remedy=remedy)
        if not self.robot.fixed_base:
            problem = f"are False, and nothing holds the floating base of {self.robot.name!r}"
            raise InvalidArgumentError(
                "collisions", problem, remedy="load the robot with fixed_base=True"
            )

    def _check_world(self, randomization: Randomization) -> None:
        """Raise InvalidArgumentError for draws of the world that this runner's scenes do not
        take.
        """
        if randomization.ground_friction is not None and not self.collisions:
            raise InvalidArgumentError(
                "ground_friction", "has no effect without collisions", remedy="leave it out"
            )
        if randomization.gravity is not None and self.build is not None:
            problem = (
                "cannot change in scenes with content of build: SAPIEN's systems keep their gravity"
            )
            raise InvalidArgumentError("gravity", problem, remedy="leave out one of them")

    def _sensed_links(self, option: str, given: Any) -> tuple[str, ...] | None:
        """Return the links of the option "contacts" or "wrenches"; None without any.

        Raises InvalidArgumentError for a link that is unknown, or has no sensor of this kind.
        """
        robot, known = self.robot, [link.name for link in self.robot.links]
        if not (links := () if given is None else tuple(names(option, given))):
            return None
        if option == "contacts" and not self.collisions:
            raise InvalidArgumentError(
                option, "need collisions, which are off", remedy="leave out collisions=False"
            )
        if self.engine_name == "sapien" and robot.dissipation == "sapien":
            problem = "need a robot without SAPIEN's link damping, which acts like a contact"
            raise InvalidArgumentError(
                option, problem, remedy="load the robot with dissipation='urdf'"
            )
        bodies = place_links(robot.tables, links if option == "wrenches" else ())
        root = next(at.link for at in bodies.values())
        for link in links:
            if link not in known:
                remedy = f"use links of {robot.name!r}: {', '.join(known)}"
                raise InvalidArgumentError(option, f"names an unknown link {link!r}", remedy=remedy)
            if bodies[link].link == root and (option == "wrenches" or robot.fixed_base):
                problem = f"names {link!r}, which no joint moves"
                raise InvalidArgumentError(
                    option, problem, remedy="name a link further along the robot"
                )
        return links

    @cached_property
    def observed(self) -> dict[str, Quantity]:
        """Quantities that the loop observes."""
        return observed(self.robot.fixed_base, contacts=self.contacts, wrenches=self.wrenches)

    @property
    def misses_contacts(self) -> bool:
        """True if robots have no collision shapes, and contacts that they would have had are
        reported.
        """
        return not self.collisions

    @property
    def switched(self) -> dict[str, bool]:
        """Options of type bool that are not at their default, by name."""
        switches = {
            entry.name: entry.default for entry in fields(self) if isinstance(entry.default, bool)
        }
        return {
            name: not default
            for name, default in switches.items()
            if getattr(self, name) != default
        }

    @property
    def solver(self) -> Physics | MujocoSolver:
        """Solver settings for the option ``physics``."""
        return (
            self.load_engine().physics[self.physics]
            if isinstance(self.physics, str)
            else self.physics
        )

    def load_engine(self) -> Engine:
        """Return the physics engine of the robots, with its packages imported.

        Raises
        ------
        InvalidArgumentError
            No engine has this name.
        MissingDependencyError
            The engine's package is not installed.
        """
        return load_engine(self.engine)

    @property
    def control_name(self) -> str:
        """Name of the control; of a :class:`Controller` its class."""
        return self.control if isinstance(self.control, str) else type(self.control).__name__

    @property
    def sets_positions(self) -> bool:
        """True if setpoints are joint positions."""
        return self.control in ("pid", "drive")

    @cached_property
    def own_command(self) -> CommandSpec | None:
        """Command that a :class:`Controller` declares; None for commands of joints."""
        return own_command(self.control)

    @cached_property
    def command(self) -> CommandSpec:
        """Names and units of the setpoint's entries."""
        return self.own_command or joint_command(
            self.robot.joint_names, self.robot.units, self.control
        )

    @cached_property
    def command_columns(self) -> tuple[tuple[AxisKind, tuple[str, ...]], ...]:
        """Last axis of each array of a command: the kind of its columns, and their names."""
        kind: AxisKind = "joint" if self.own_command is None else "entry"
        return (*[(kind, self.command.names)] * 3, ("joint", self.robot.joint_names))

    @cached_property
    def command_coupling(self) -> Coupling | None:
        """Coupling of the joints that setpoints are for; None where there is none."""
        return (
            self.robot.coupling
            if self.sets_positions and not self.robot.independent.all()
            else None
        )

    @property
    def tool_pose(self) -> Callable[[Rows], NDArray[np.float32]] | None:
        """Function from positions (..., dof) to poses of the tool (..., 7); None where setpoints
        are not poses.
        """
        return self.control.tool_pose if isinstance(self.control, OperationalSpace) else None

    def has_stiction(self, actuators: bp.Actuators | None) -> bool:
        """Return whether joints with ``actuators`` have Coulomb friction that the loop models."""
        added = actuators is not None and added_friction(Friction(), actuators).coulomb is not None
        return (
            bool(self.robot.friction.any())
            or added
            or getattr(self.randomization, "friction", None) is not None
        )

    @property
    def has_pushes(self) -> bool:
        """True if floating bases are pushed."""
        return self.randomization is not None and self.randomization.push is not None

    def check_params(self, params: bp.PIDParams) -> bp.PIDParams:
        """Return ``params``, as a read-only copy, if they fit the robot, the number of envs and the
        control.

        Raises
        ------
        InvalidArgumentError
            They do not fit.
        """
        instance("params", params, bp.PIDParams, "build them with robot.params() or make_params()")
        if params.gain_units is not None and self.control != "pid":
            raise InvalidArgumentError(
                "gain_units",
                f"have no meaning under control {self.control_name!r}",
                remedy="use control 'pid', or params with gain_units 'effort'",
            )
        if isinstance(params.gain_units, PerMassMatrix) and self.loops:
            problem = (
                f"are 'mass_matrix', which needs a kinematic tree: {', '.join(self.loops)} closes a"
                " loop of links"
            )
            raise InvalidArgumentError("gain_units", problem, remedy='use robot.designed("effort")')
        check_gain_units(params)
        if self.control == "drive":
            check_drive(params)
        if params.num_joints != self.robot.dof:
            raise InvalidArgumentError(
                "params",
                f"hold {params.num_joints} joints, robot {self.robot.name!r} has {self.robot.dof}",
                remedy=f"give one gain for each of {', '.join(self.robot.joint_names)}",
            )
        if params.num_envs not in (1, self.num_envs):
            raise InvalidArgumentError(
                "params",
                f"hold {params.num_envs} envs, the runner has {self.num_envs}",
                remedy="give one row, or one row per env",
            )
        if self.randomization is not None:
            check_params(self.randomization, params, self.robot)
        return frozen(params)

    def check_actuators(self, actuators: bp.Actuators | None) -> bp.Actuators | None:
        """Return ``actuators`` as :func:`batchpid.sim.robot.actuator_checks.fit_actuators` does;
        None if every effect is off.

        None selects the robot's own actuators; control "drive" uses only their friction and
        armature.

        Raises
        ------
        InvalidArgumentError
            They do not fit.
        """
        if actuators is None:
            actuators = self.robot.actuators or IDEAL
            actuators = actuators.joint_side() if self.control == "drive" else actuators
        fitted: bp.Actuators | None = fit_actuators(
            actuators, self.robot, self.num_envs, self.control
        )
        fitted = None if fitted is None or fitted.is_ideal else fitted
        if self.randomization is not None:
            fitted = prepared_actuators(self.randomization, fitted, self.robot, self.control)
        if fitted is not None and self.backend == "jax":
            raise _not_in_program("actuators", "are given")
        return None if fitted is None else frozen(fitted)

    def with_values(self, **values: Any) -> RunnerOptions:
        """Return a copy with other ``values``, as the attributes hold them: they are not
        checked.
        """
        changed = copy.copy(self)
        vars(changed).update(values)
        return changed

    def values_for(self, place: Place) -> Document:
        """Return the options that are marked with ``place``, by name.

        - "snapshot": values that two runners must share to restore each other's snapshots;
        - "recording": fields of :class:`batchpid.sim.RunInfo`, and in its field "options" the
          values without a field;
        - "scene": fields of :class:`batchpid.sim.engine.scene_spec.SceneSpec`.
        """
        kept = {name: entry.kept[place] for name, entry in OPTIONS.items() if place in entry.kept}
        values = {name: getattr(self, source or name) for name, source in kept.items()}
        if place == "recording" and (further := sorted(values.keys() - RunInfo.__annotations__)):
            values["options"] = {name: values.pop(name) for name in further}
        return values

    def describe(self) -> Document:
        """Return robot and options that two runners must share to restore each other's snapshots,
        as plain values.
        """
        robot, command = self.robot, self.own_command
        return {
            **robot.describe(),
            "joints": list(robot.joint_names),
            **{name: _plain(value) for name, value in self.values_for("snapshot").items()},
            "ignored_pairs": digest(robot.ignored_pairs),
            "robot_actuators": digest(known_joints(robot)),
            "controller": self.versioned_control,
            "command": None if command is None else list(command.names),
        }

    @property
    def engine_name(self) -> str:
        """Name by which the engine calls itself."""
        return self.load_engine().name

    @property
    def physics_name(self) -> str:
        """Preset of the solver settings, or the settings as text."""
        return str(self.physics)

    @property
    def solver_settings(self) -> list[Any]:
        """Values of the fields of :attr:`solver`."""
        return list(astuple(self.solver))

    @property
    def robot_name(self) -> str:
        """Name of the robot."""
        return self.robot.name

    @property
    def versioned_control(self) -> str | None:
        """Class and ``version`` of a :class:`Controller`; None for the name of a control."""
        return _versioned_name(self.control)

    @property
    def versioned_build(self) -> str | None:
        """Name and ``version`` of ``build``; None without one."""
        return _versioned_name(self.build)

    @property
    def guard_digest(self) -> str:
        """Digest of the setpoint guard."""
        return digest(self.guard is not None and self.guard)

    @property
    def distributions(self) -> Document | None:
        """The randomization as plain values."""
        return None if self.randomization is None else self.randomization.to_dict()


def _control(value: object, robot: Robot, tool: Any) -> Any:
    """Return a control, checked; "osc" becomes the controller of the link ``tool``."""
    is_controller = callable(value) and callable(getattr(value, "init", None))
    name = None if is_controller else choice("control", value, (*get_args(ControlMode), "osc"))
    if is_controller:
        own_command(value)  # raises for an invalid command
    if tool is not None:
        tool = instance("tool", tool, str, "name a link of the robot")
    if tool is not None and name != "osc" and tool != getattr(value, "link", None):
        raise InvalidArgumentError(
            "tool", "is for control 'osc'", value=tool, remedy="leave it out"
        )
    if not robot.fixed_base and name == "osc":
        problem = f"'osc' needs a fixed base, which {robot.name!r} does not have"
        remedy = "load the robot with fixed_base=True, or control its joints"
        raise InvalidArgumentError("control", problem, remedy=remedy)
    if name != "osc":
        return value
    try:
        return OperationalSpace(robot, default_tool(robot) if tool is None else tool)
    except InvalidArgumentError as error:
        named = "tool" if error.argument == "link" else error.argument
        raise InvalidArgumentError(
            named, error.problem, value=error.value, remedy=error.remedy
        ) from None


def _plain(value: object) -> object:
    """Return the value of an option in JSON's types."""
    return (
        value.tolist()
        if isinstance(value, np.ndarray)
        else list(value)
        if isinstance(value, tuple)
        else value
    )


def _versioned_name(value: object) -> str | None:
    """Return the class of an object, or the name of a function, with its ``version``; None for a
    text or None.
    """
    if value is None or isinstance(value, str):
        return None
    name = getattr(value, "__qualname__", type(value).__qualname__)
    return f"{name} {getattr(value, 'version', '')}"


def worker_count(workers: int | None) -> int:
    """Return the number of worker processes for the option ``workers``; None selects one per
    available core.
    """
    return len(os.sched_getaffinity(0)) if workers is None else checked_option("workers", workers)


def _places(workers: Any, cluster: Any) -> tuple[int | None, Ray | None]:
    """Return the options ``workers`` and ``cluster``, checked; one of them is None."""
    if cluster is None:
        return worker_count(workers), None
    cluster = instance(
        "cluster", Ray() if cluster == "ray" else cluster, Ray, "pass 'ray' or Ray(...)"
    )
    if workers is not None:
        remedy = "pass cluster=Ray(cpus_per_node=...)"
        raise InvalidArgumentError("workers", "is not for a cluster", value=workers, remedy=remedy)
    return None, cluster


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
    if control not in ("pid", "drive"):
        return robot.params(kp=0.0, ki=0.0, kd=0.0)
    settings = robot.settings
    if control == "drive":
        if settings is None:
            return robot.designed("effort").replace(
                ki=0.0, setpoint_weight=None, derivative_filter_time=None
            )
        return robot.params(
            kp=settings.drive_stiffness, ki=0.0, kd=settings.drive_damping, effort_limit=None
        )
    return robot.tuned() if robot.has_tuned else robot.designed("effort" if loops else None)


def _not_in_program(argument: str, problem: str) -> InvalidArgumentError:
    """Return the error for an option that the program of backend "jax" does not have."""
    problem = f"{problem}, which the program of backend 'jax' does not have"
    return InvalidArgumentError(argument, problem, remedy="use backend='numpy'")
