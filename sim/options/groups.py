"""Options of a Runner in three groups, each declared once.

An option is a field of :class:`SceneOptions`, :class:`ControlOptions` or :class:`WorkerOptions`. The
field has its type, default, bounds and text, the places that keep it, and the help of its flag. The
checks of plain values, the table of options in docs/runner.md, the flags, and what snapshots and
recordings hold come from it. :class:`batchpid.sim.Runner` has the same signature, for editors.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple, Protocol, Self, get_args, get_type_hints

import batchpid as bp
from batchpid.arrays.array_types import Array, Rows
from batchpid.arrays.elementwise import require_jax
from batchpid.arrays.field_tables import Field, plain
from batchpid.checks import choice, instance, names
from batchpid.errors import InvalidArgumentError
from batchpid.sim.description.merging import place_links
from batchpid.sim.description.tables import MjcfFile
from batchpid.sim.engine.protocol import Engine, load_engine, require
from batchpid.sim.engine.scene_spec import MujocoSolver, Physics
from batchpid.sim.randomization.checks import check_robot
from batchpid.sim.randomization.randomization import Randomization
from batchpid.sim.robot.robot import Robot
from batchpid.sim.robot.robot_model import link_tree
from batchpid.sim.signals import own_command
from batchpid.sim.tool_space import OperationalSpace
from batchpid.stages import Stage, fit_stages

EngineName = Literal["sapien", "mujoco"]
DEFAULT_ENGINE: EngineName = "mujoco"
"""Engine of runners, commands, searches and comparisons that name none."""
PhysicsPreset = Literal["accurate", "fast"]
ControlMode = Literal["pid", "drive", "effort"]
Compensation = Literal["gravity+coriolis+friction", "gravity+coriolis", "gravity", "none"]
Backend = Literal["numpy", "jax"]
FaultAction = Literal["hold", "reset"]
InvalidInputAction = Literal["raise", "contain"]
Place = Literal["snapshot", "recording", "scene", "restored", "processes", "next commands"]
"""Places that hold the value of an option, and reasons why a snapshot can be restored in a runner
with another value.

- "snapshot": it must be the same in the runner that restores the snapshot;
- "recording": a field of :class:`batchpid.sim.RunInfo`;
- "scene": a field of :class:`batchpid.sim.engine.scene_spec.SceneSpec`;
- "restored": the snapshot holds the value, and the runner takes it over;
- "processes": the value decides where and how fast the envs run; results are bit-identical for all
  values;
- "next commands": the value is a default of later commands (``substeps``), or decides which of them
  are refused.
"""


class Option(NamedTuple):
    """Places that hold an argument of a Runner, and its flag; made by :func:`option`."""

    places: Mapping[str, str]
    """Attribute of :class:`batchpid.sim.RunnerOptions` that each :data:`Place` keeps; "" for the
    attribute of the argument's name.
    """
    flag: str
    """Help of the flag of `batchpid rollout` with the argument's name; "" for no flag."""


def option(*places: Place, flag: str = "", **attributes: str) -> Option:
    """Return the option that ``places`` hold; ``attributes`` are further places, with the attribute
    that each holds.
    """
    return Option(dict.fromkeys(places, "") | attributes, flag)


def check_plain(record: object) -> None:
    """Convert the fields of a frozen dataclass to their declared types, and check their bounds."""
    # The class is frozen; its __dict__ is not.
    kinds = get_type_hints(type(record), include_extras=True)
    for name, value in vars(record).items():
        vars(record)[name] = plain(name, kinds[name], value)


@dataclass(
    frozen=True,
    eq=False,
    kw_only=True,
)
class OptionGroup:
    """Base of the groups of options."""

    def __post_init__(self) -> None:
        check_plain(self)

    def fit(self, robot: Robot) -> Self:
        """Return these options for ``robot``, checked, with a value for each default.

        Raises InvalidArgumentError for an option that is out of range, or not for this robot.
        """
        return self

    def changed(self, **values: object) -> Self:
        """Return the options with other ``values``."""
        # Without the checks of __post_init__: these values have passed them.
        made = object.__new__(type(self))
        vars(made).update(vars(self) | values)
        return made


@dataclass(
    frozen=True,
    eq=False,
    kw_only=True,
)
class SceneOptions(OptionGroup):
    """Engine, ground, contacts, and content of the scenes."""

    engine: Annotated[
        EngineName,
        option(
            "snapshot",
            "recording",
            flag="Physics engine; sapien is several times as slow, with other contacts.",
        ),
    ] = DEFAULT_ENGINE
    """Physics engine: ``"mujoco"`` (the default), or ``"sapien"``, which is for Linux on x86-64 and
    several times as slow (docs/performance.md).
    """
    physics: Annotated[
        PhysicsPreset | Physics | MujocoSolver,
        option(
            "recording",
            snapshot="solver",
            scene="solver",
        ),
    ] = "accurate"
    """Solver settings: ``"accurate"`` (the default: those of SAPIEN), ``"fast"`` (fewer
    iterations), a :class:`batchpid.sim.Physics` for SAPIEN, or a :class:`batchpid.sim.MujocoSolver`
    for MuJoCo.
    """
    collisions: Annotated[
        bool,
        option(
            "snapshot",
            "recording",
            "scene",
        ),
    ] = True
    """Robots have collision shapes; default True. False removes the shapes and the ground, for free
    motion only: robots then pass through themselves. Masses, inertias and joint limits stay.
    """
    ground: Annotated[
        bool | None,
        option(
            "snapshot",
            "recording",
            "scene",
        ),
    ] = None
    """Add a ground plane at height 0 to every scene. Default :attr:`Robot.has_ground`: True, unless
    the base is fixed so low that other links reach the ground at the start pose. With engine
    "mujoco" the planes in the world of an MJCF file replace the ground; by default they are as in
    the file.
    """
    contacts: Annotated[Sequence[str] | None, option("snapshot", "recording", "scene")] = None
    """Links whose contact forces are observed: ``obs.contact_force`` and ``obs.touching``; default
    none. Each link senses the contacts of its own shapes. A fixed base is refused.
    """
    wrenches: Annotated[Sequence[str] | None, option("snapshot", "recording", "scene")] = None
    """Links with a sensor of the force and torque that the parent exerts on the link:
    ``obs.wrench``; default none. It needs ``engine="mujoco"``.
    """
    build: Annotated[Callable[[Any, int], Any] | None, option("snapshot", "scene")] = None
    """Function ``build(scene, env)`` that adds actors and articulations to the ``sapien.Scene`` of each env;
    it needs ``engine="sapien"``.
    Visuals and lights are ignored, so code that was written for a screen runs unchanged. It may
    return the entities that :meth:`batchpid.sim.Runner.poses` reports. A reset returns the content
    to the poses that ``build`` gave it.
    """
    randomization: Annotated[Randomization | None, option("snapshot", "recording")] = None
    """Distributions from which payload, masses, friction, gains and more are drawn for each env and
    episode (docs/randomization.md); default none.
    """

    def load_engine(self) -> Engine:
        """Return the physics engine of the robots, with its packages imported.

        Raises
        ------
        InvalidArgumentError
            No engine has this name, or SAPIEN is not installed.
        MissingDependencyError
            MuJoCo is too old.
        """
        return load_engine(self.engine)

    @property
    def solver(self) -> Physics | MujocoSolver:
        """Solver settings for the option ``physics``."""
        if isinstance(self.physics, str):
            settings: Physics | MujocoSolver = self.load_engine().physics[self.physics]
            return settings
        return self.physics

    def file_of(self, robot: Robot) -> MjcfFile | None:
        """Return the MJCF file that the engine simulates as it is; None for others, and in
        SAPIEN.
        """
        if self.engine == "mujoco":
            return robot.mjcf
        return None

    def fit(self, robot: Robot) -> Self:
        engine = self.load_engine()
        if not engine.is_physics(self.physics):
            choice("physics", self.physics, engine.physics)
        if robot.source.dissipation == "sapien":
            require(engine, "sapien_dissipation", "robot")
        # MuJoCo compiles a scene as a whole: it has no content of the caller's own.
        if self.build is not None:
            require(engine, "build", "build")
            if not callable(self.build):
                remedy = "define build(scene, env)"
                raise InvalidArgumentError("build", "must be a function", remedy=remedy)
        self._check_randomization(robot)
        # By default an MJCF file has its own floor; other robots stand on one, or hang over it.
        ground = self.ground
        if not self.collisions:
            self._check_without_collisions(robot)
            ground = False
        elif ground is None:
            file = self.file_of(robot)
            ground = robot.has_ground or (file is not None and file.has_floor)
        contacts = self._sensed_links("contacts", self.contacts, robot)
        wrenches = self._sensed_links("wrenches", self.wrenches, robot)
        return self.changed(
            ground=ground,
            contacts=contacts,
            wrenches=wrenches,
        )

    def _check_randomization(self, robot: Robot) -> None:
        """Raise InvalidArgumentError for draws that robot or scenes do not take."""
        if self.randomization is None:
            return
        remedy = "pass e.g. Randomization(payload=Uniform(0, 1))"
        draws = instance("randomization", self.randomization, Randomization, remedy)
        check_robot(draws, robot, self.file_of(robot))
        if draws.ground_friction is not None and not self.collisions:
            problem = "has no effect without collisions"
            raise InvalidArgumentError("ground_friction", problem, remedy="leave it out")
        if draws.gravity is not None and self.build is not None:
            problem = "cannot vary in scenes with build, which SAPIEN builds once"
            raise InvalidArgumentError("gravity", problem, remedy="leave out one of them")

    def _check_without_collisions(self, robot: Robot) -> None:
        """Raise InvalidArgumentError for what needs the collisions that are off."""
        file = self.file_of(robot)
        # A robot that nothing holds would fall for ever.
        if file is None:
            falling = []
        else:
            falling = [*file.falling]
        if not robot.fixed_base:
            falling.append("the floating base")
        if falling:
            problem = f"are False, and nothing holds {', '.join(falling)}"
            raise InvalidArgumentError("collisions", problem, remedy="leave it out")
        for argument in ("ground", "contacts", "build"):
            if getattr(self, argument):
                problem = "need collisions, which are off"
                raise InvalidArgumentError(argument, problem, remedy="leave out collisions=False")

    def _sensed_links(
        self, argument: str, value: Sequence[str] | None, robot: Robot
    ) -> tuple[str, ...] | None:
        """Return the links of the option "contacts" or "wrenches"; None without any.

        Raises InvalidArgumentError for a link that is unknown, or has no sensor of this kind.
        """
        if value is None:
            return None
        links = tuple(names(argument, value))
        if not links:
            return None
        if argument == "wrenches":
            require(self.load_engine(), "wrenches", argument)
        # A link that no joint moves has no sensor: it is part of the root's body.
        bodies = place_links(robot.tables, links if argument == "wrenches" else ())
        root = next(place.link for place in bodies.values())
        for link in links:
            choice(argument, link, list(robot.bodies))
            if bodies[link].link == root and (argument == "wrenches" or robot.fixed_base):
                problem = f"names {link!r}, which no joint moves"
                remedy = "name a link beyond a joint"
                raise InvalidArgumentError(argument, problem, remedy=remedy)
        return links


class Controller(Protocol):
    """Controller of the caller's own, for the option ``control``; arrays are (envs, dof), as in
    ``robot.joint_names``.

    It is called at every sim step, in the worker processes, for some of the envs at a time: the
    effort of an env must depend on its own rows alone. It travels to the workers by cloudpickle,
    and may call NumPy or a jitted function.

    A setpoint has a number for each joint, unless the controller has an attribute ``command``, a
    :class:`batchpid.sim.CommandSpec`. Then it is (envs, size).

    A snapshot fits a controller of the same class, whose attribute ``version`` is the same where it
    has one.
    """

    def init(self, robot: Robot, num_envs: int, timestep: float) -> Any:
        """Return the state of ``num_envs`` envs at their start: None, an array, or tuples and dicts
        of these.

        ``timestep`` [s] is the time from one call of the controller to the next. Every array has
        the envs as its first axis: states are reset by mask, and kept in snapshots. Later states
        have the same structure, shapes and dtypes.
        """

    def __call__(
        self,
        state: Any,
        setpoint: Rows,
        qpos: Rows,
        qvel: Rows,
        passive: Rows,
    ) -> tuple[Any, Array]:
        """Return the new state, and the joint efforts [N m or N], which the runner clips to the
        params' limits.

        An env that has failed is given the ``neutral`` setpoint of the command, by default zeros.
        ``passive`` is the passive force that the runner's ``compensate`` selects, plus the caller's
        feedforward. The arrays are read-only copies, which the controller may keep.
        """


@dataclass(
    frozen=True,
    eq=False,
    kw_only=True,
)
class ControlOptions(OptionGroup):
    """Time step, law, gains, motors and guard; what makes an env fail, and what happens then."""

    timestep: Annotated[
        float,
        Field("seconds, not a rate: 1/2000", low=1e-6, high=0.1),
        option("snapshot", "recording", "scene"),
    ] = 1 / 2000
    """Time step of simulation and control [s]; default 1/2000."""
    substeps: Annotated[int, Field(low=1, high=1_000_000), option("recording", "next commands")] = (
        20
    )
    """Sim steps of one tick, all under the same setpoint; default 20. The control runs at every sim
    step.
    """
    params: Annotated[bp.PIDParams | None, option("restored")] = None
    """PID parameters of one row, or one row per env. Default: see
    :func:`batchpid.sim.options.options.default_params`.
    """
    control: Annotated[
        ControlMode | Literal["osc"] | Controller,
        option("snapshot", recording="control_name"),
    ] = "pid"
    """``"pid"``, the default; ``"drive"``: the engine's internal PD drive, with the params' kp and kd
    as stiffness and damping, a baseline whose compensation is not limited; ``"effort"``: the
    setpoint is the joint effort; ``"osc"``: operational-space control of the link ``tool``, whose
    setpoints are poses (7,), a :class:`batchpid.sim.OperationalSpace` with its defaults; or a
    :class:`Controller`.
    """
    tool: Annotated[str | None, option("snapshot", "recording")] = None
    """Link that control "osc" moves; default the last link of the robot's longest chain."""
    backend: Annotated[
        Backend,
        option("snapshot"),
    ] = "numpy"
    """Library of the control: ``"numpy"``, the default, or ``"jax"``, which compiles the stages of
    a sim step, a :class:`Controller` among them, for the CPU: for a controller or stages in JAX. The
    last bits of results differ between the two, and between processors. Programs of whole loops are
    :func:`batchpid.sim.closed_loop`.
    """
    compensate: Annotated[
        Compensation,
        option("snapshot", "recording"),
    ] = "gravity+coriolis+friction"
    """Compensation added to the effort at every sim step: the passive force (gravity, Coriolis and
    centrifugal forces) and the known Coulomb friction in the direction of the setpoint.
    ``"gravity+coriolis+friction"``, the default, or a part of it; under control "effort" friction
    is not compensated. On a floating base the passive force is computed as if the base were fixed:
    the weight of the base on the legs depends on their contacts, and the law carries it.
    """
    actuators: Annotated[bp.Actuators | None, option("restored")] = None
    """Delays, limits, friction and errors of motors and sensors: :func:`batchpid.make_actuators`,
    of one row, or one row per env. None, the default, selects the robot's actuators; control
    "drive" uses only their friction and armature. ``bp.Actuators()`` is ideal. The control gets
    measured positions and velocities. Observations hold the true ones, and the delivered effort.
    """
    stages: Annotated[Sequence[Stage], option("snapshot")] = ()
    """Further stages of a sim step, such as a thermal limit, each a :class:`batchpid.stages.Stage`
    with ``after``, the name of the stage before it (docs/stages.md); default none.
    """
    plan: Annotated[bp.Plan | None, option("snapshot", recording="plan_blend")] = None
    """Plan of the chunks of a slow policy: :func:`batchpid.make_plan`. :meth:`Runner.step` then
    takes chunks, and ``obs.starved`` counts the sim steps without a row ahead. Default none.
    """
    guard: Annotated[bool | bp.Guard | None, option("snapshot")] = None
    """Limits of setpoints, applied at every sim step: True for :meth:`batchpid.sim.Robot.guard`, or
    :func:`batchpid.make_guard`; default none. ``obs.guarded`` is True where a setpoint was
    changed.
    """

    on_fault: Annotated[FaultAction, option("snapshot")] = "hold"
    """Action when an env fails: ``"hold"`` (default) keeps it at rest in its last valid state, with
    ``ok`` False until it is reset; ``"reset"`` returns it to its last start, with ``ok`` False for
    that tick. An env fails when its state, or the effort of a :class:`Controller`, is not finite,
    or when a position is beyond 1e6 rad or m. The other envs are not affected.
    """
    on_invalid_input: Annotated[InvalidInputAction, option("next commands")] = "raise"
    """Response to NaN or infinity in a command: ``"raise"`` (default) raises an error, and
    ``"contain"`` lets only the env concerned fail.
    """

    def fit(self, robot: Robot) -> Self:
        control = self.control
        tool = self.tool
        if control == "osc":
            if not robot.fixed_base:
                problem = f"'osc' needs a fixed base, which {robot.name!r} does not have"
                remedy = "load the robot with fixed_base=True, or control its joints"
                raise InvalidArgumentError("control", problem, remedy=remedy)
            if tool is None:
                tool = link_tree(robot).tool
            # From here on it is a controller like the caller's own.
            control = OperationalSpace(robot, choice("tool", tool, robot.kinematic_tree().links))
        elif callable(control) and callable(getattr(control, "init", None)):
            own_command(control)  # raises for an invalid command
        else:
            choice("control", control, (*get_args(ControlMode), "osc"))
        if isinstance(control, OperationalSpace):
            link = control.link
        else:
            link = None
        if tool not in (None, link):
            problem = "is for control 'osc'"
            raise InvalidArgumentError("tool", problem, value=tool, remedy="leave it out")
        if self.backend == "jax":
            require_jax()
            platforms = os.environ.get("JAX_PLATFORMS") or "cpu"
            if "cpu" not in platforms.split(","):
                problem = f"'jax' needs JAX on the CPU, and JAX_PLATFORMS is {platforms!r}"
                remedy = "add cpu to it, or use backend='numpy'"
                raise InvalidArgumentError("backend", problem, remedy=remedy)
        stages = fit_stages(self.stages)
        return self.changed(control=control, tool=link, stages=stages)

    @property
    def control_name(self) -> str:
        """Name of the control; of a :class:`Controller` its class."""
        if isinstance(self.control, str):
            return self.control
        return type(self.control).__name__

    @property
    def plan_blend(self) -> str | None:
        """Blend of the plan; None without a plan."""
        if self.plan is None:
            return None
        return str(self.plan.options()["blend"])

    @property
    def sets_positions(self) -> bool:
        """True if setpoints are joint positions."""
        return self.control in ("pid", "drive")


@dataclass(
    frozen=True,
    eq=False,
    kw_only=True,
)
class WorkerOptions(OptionGroup):
    """Processes and machines that run the envs."""

    first_env: Annotated[int, Field(high=1e9), option("snapshot")] = 0
    """Number of the first env; default 0. With ``first_env=100`` a runner is bit-identical to envs
    100, ... of a larger one: sensor noise, the streams of a randomization and ``build`` depend on
    the number of the env.
    """
    workers: Annotated[
        int | None,
        Field(high=1024),
        option(
            "processes",
            flag="Processes that step the scenes; 0: this process. Default: one per available core.",
        ),
    ] = None
    """Processes that step the scenes; 0 runs the same code in this process. Default: one per
    available core, each pinned to its core. Results are bit-identical for any number of workers.
    """
    timeout: Annotated[float, Field("seconds", low=1e-3, high=1e9), option("processes")] = 60.0
    """Time [s], beyond an upper bound of the work's duration, after which a worker counts as stuck,
    and is replaced; default 60.
    """
    cluster: Annotated[Literal["ray"] | None, option("processes")] = None
    """``"ray"``: the workers run on the machines of a Ray cluster, with bit-identical results
    (docs/reliability.md).
    """

    def fit(self, robot: Robot) -> Self:
        if self.cluster is None:
            workers = self.workers
            return self.changed(
                workers=len(os.sched_getaffinity(0)) if workers is None else workers
            )
        # Each machine of a cluster has its own number of workers.
        if self.workers is not None:
            problem = "is not for a cluster, whose machines have a worker for each CPU"
            raise InvalidArgumentError(
                "workers", problem, value=self.workers, remedy="leave it out"
            )
        return self
