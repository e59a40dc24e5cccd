"""Arguments of a Runner: the record in which each is declared once.

An option has its type, default, bounds and documentation here, the places that keep it, and the
help of its flag. From this record come the signature of :class:`batchpid.sim.Runner`, the checks of
plain numbers, bools and choices, the values that snapshots, recordings and scenes keep, and the
flags of the command line. Checks of options that depend on the robot or on each other are in
:mod:`batchpid.sim.options`. CONTRIBUTING.md lists the steps for a new option.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from importlib.util import find_spec
from typing import (
    Annotated,
    Any,
    Concatenate,
    Literal,
    NamedTuple,
    ParamSpec,
    Protocol,
    get_type_hints,
)

from numpy.typing import ArrayLike

import batchpid as bp
from batchpid.arrays.array_types import Kind, Rows
from batchpid.arrays.field_tables import Field, declared, plain
from batchpid.sim.engine.physics import MujocoSolver, Physics
from batchpid.sim.randomization.randomization import Randomization
from batchpid.sim.ray_options import Ray
from batchpid.sim.robot.robot import Robot

P = ParamSpec("P")
ControlMode = Literal["pid", "drive", "effort"]


class Controller(Protocol):
    """Controller of the caller's own, for the option ``control``; arrays are (envs, dof), as in
    ``robot.joint_names``.

    It is called at every sim step, in the worker processes, for some of the envs at a time: the
    effort of an env must depend on its own rows alone. It travels to the workers by cloudpickle,
    and may call NumPy or a jitted function.

    A setpoint has a number for each joint, unless the controller has an attribute ``command``: a
    :class:`batchpid.sim.CommandSpec`, or a sequence of names, such as ``("x", "y")``. Then it is
    (envs, size).

    A snapshot fits a controller of the same class, whose attribute ``version`` is the same where it
    has one.
    """

    def init(self, robot: Robot, num_envs: int) -> Any:
        """Return the state of ``num_envs`` envs at their start: None, an array, or tuples and dicts
        of these.

        Every array has the envs as its first axis: states are reset by mask, and kept in snapshots.
        Later states have the same structure, shapes and dtypes.
        """

    def __call__(
        self,
        state: Any,
        setpoint: Rows,
        qpos: Rows,
        qvel: Rows,
        passive: Rows,
    ) -> tuple[Any, Any]:
        """Return the new state, and the joint efforts [N m or N], which the runner clips to the
        params' limits.

        An env that has failed is given the ``neutral`` setpoint of the command, by default zeros
        within its bounds. ``passive`` is the passive force that the runner's ``compensate``
        selects, plus the caller's feedforward. The arrays are read-only copies, which the
        controller may keep.
        """


Compensation = Literal["gravity+coriolis+friction", "gravity+coriolis", "gravity", "none"]
Backend = Literal["numpy", "jax"]
EngineName = Literal["sapien", "mujoco"]
DEFAULT_ENGINE: EngineName = "mujoco" if find_spec("sapien") is None else "sapien"
"""SAPIEN where it is installed, which is on Linux with x86-64; elsewhere MuJoCo."""
PhysicsPreset = Literal["accurate", "fast"]
FaultAction = Literal["hold", "reset"]
InvalidInputAction = Literal["raise", "contain"]
Place = Literal["snapshot", "recording", "scene"]
Role = Literal["restored", "processes", "next commands"]
"""Reason for which a snapshot may be restored in a runner with another value of an option.

- "restored": the snapshot holds the value, and the runner takes it over;
- "processes": the value decides where and how fast the envs run; results are bit-identical for all
  values;
- "next commands": the value is a default of later commands (``substeps``), or decides which of them
  are refused.
"""


class Option(NamedTuple):
    """Where an argument of a Runner is kept and shown, by :func:`option`."""

    kept: Mapping[str, str]
    """Attribute of :class:`batchpid.sim.RunnerOptions` that each place keeps; "" for the attribute
    of the argument's name.
    """
    role: Role | None
    """Reason for which the value may differ in the runner that restores a snapshot; None if it may
    not.
    """
    flag: str
    """Help of the flag of `batchpid rollout` with the argument's name; "" for no flag."""


def option(*kept: Place, role: Role | None = None, flag: str = "", **kept_as: str) -> Option:
    """Return the option that the places ``kept`` keep; ``kept_as`` are further places and the
    attributes they keep.
    """
    return Option(dict.fromkeys(kept, "") | kept_as, role, flag)


@dataclass(frozen=True, eq=False, kw_only=True)
class RunnerKeywords:
    """Arguments of a :class:`batchpid.sim.Runner`, as they are passed; all but the first two may be
    left out.

    A snapshot and the runner that restores it must agree in the options that snapshots keep.
    """

    robot: Annotated[Robot, option(snapshot="robot_name")] = field(kw_only=False)
    """From :meth:`batchpid.sim.Robot.load`."""
    num_envs: Annotated[int, Field(low=1, high=1_000_000), option("snapshot")] = field(
        kw_only=False
    )
    """Number of robots, one in each scene."""
    params: Annotated[bp.PIDParams | None, option(role="restored")] = None
    """PID parameters of one row, or one row per env. Default: see
    :func:`batchpid.sim.options.default_params`.
    """

    first_env: Annotated[int, Field(high=1e9), option("snapshot")] = 0
    """Number of the first env; default 0. With ``first_env=100`` a runner is bit-identical to envs
    100, ... of a larger one: sensor noise, the streams of a randomization and ``build`` depend on
    the number of the env.
    """
    workers: Annotated[
        int | None,
        Field(high=1024),
        option(
            role="processes",
            flag="Processes that step the scenes; 0: this one. Default: one per available core.",
        ),
    ] = None
    """Processes that step the scenes; 0 runs the same code in this process. Default: one per
    available core, each pinned to its core. Results are bit-identical for any number of workers.
    """
    timestep: Annotated[
        float,
        Field("seconds, not a rate: 1/2000", low=1e-6, high=0.1),
        option("snapshot", "recording", "scene"),
    ] = 1 / 2000
    """Time step of simulation and control [s]; default 1/2000."""
    substeps: Annotated[
        int, Field(low=1, high=1_000_000), option("recording", role="next commands")
    ] = 20
    """Sim steps of one tick, all under the same setpoint; default 20. The control runs at every sim
    step.
    """
    control: Annotated[
        ControlMode | Literal["osc"] | Controller,
        option(snapshot="control_name", recording="control_name"),
    ] = "pid"
    """``"pid"``, the default; ``"drive"``: the engine's internal PD drive, with the params' kp and
    kd as stiffness and damping; ``"effort"``: the setpoint is the joint effort; ``"osc"``:
    operational-space control of the link ``tool``, whose setpoints are poses (7,), a
    :class:`batchpid.sim.OperationalSpace` with its defaults; or a :class:`Controller`.
    """
    tool: Annotated[str | None, option("snapshot", "recording")] = None
    """Link that control "osc" moves; default the last link of the robot's longest chain."""
    backend: Annotated[
        Backend,
        option(
            "snapshot", flag="Library of the law: NumPy, or JAX, as one program with the steps."
        ),
    ] = "numpy"
    """Library of the law: ``"numpy"``, the default, or ``"jax"``, which compiles law and sim steps
    of a tick, and a :class:`Controller`, into one XLA program for the CPU (docs/performance.md). It
    needs native code, control "pid", "effort" or a :class:`Controller`, and has no coupled joints,
    actuators, randomization and guard. The last bits of results differ between the two, and between
    processors.
    """
    compensate: Annotated[
        Compensation,
        option(
            "snapshot",
            "recording",
            flag="Passive force and known friction, added at every sim step.",
        ),
    ] = "gravity+coriolis+friction"
    """Compensation added to the effort at every sim step: the passive force (gravity, Coriolis and
    centrifugal forces) and the known Coulomb friction in the direction of the setpoint.
    ``"gravity+coriolis+friction"``, the default, or a part of it; under control "effort" friction
    is not compensated. On a floating base the passive force is computed as if the base were fixed:
    the weight of the base on the legs depends on their contacts, and the law carries it.
    """
    engine: Annotated[
        EngineName,
        option(
            "scene",
            snapshot="engine_name",
            recording="engine_name",
            flag="Physics engine; mujoco is several times as fast, and its contacts differ.",
        ),
    ] = DEFAULT_ENGINE
    """Physics engine: ``"sapien"``, the reference and the default where it is installed, or
    ``"mujoco"``, several times as fast (docs/two-engines.md).
    """
    physics: Annotated[
        PhysicsPreset | Physics | MujocoSolver,
        option(
            snapshot="solver_settings",
            recording="physics_name",
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
    motion only. Masses, inertias and joint limits stay. A
    :class:`batchpid.sim.MissedContactWarning` names the robots that would have touched
    something.
    """
    ground: Annotated[
        bool | None,
        option(
            "snapshot",
            "recording",
            "scene",
            flag=(
                "Ground at height 0. Default: on, unless links of a fixed robot reach it at the"
                " start pose."
            ),
        ),
    ] = None
    """Add a ground plane at height 0 to every scene. Default :attr:`Robot.has_ground`: True, unless
    the base is fixed so low that other links reach the ground at the start pose. With engine
    "mujoco" the planes in the world of an MJCF file replace the ground; by default they are as in
    the file.
    """
    contacts: Annotated[Sequence[str] | None, option("snapshot", "recording", "scene")] = None
    """Links whose contact forces are observed: ``obs.contact_force`` and ``obs.touching``; default
    none. Links that are connected by fixed joints count as one. A fixed base is refused. SAPIEN
    needs ``dissipation="urdf"``.
    """
    wrenches: Annotated[Sequence[str] | None, option("snapshot", "recording", "scene")] = None
    """Links with a sensor of the force and torque that the parent exerts on the link:
    ``obs.wrench``; default none. SAPIEN needs ``dissipation="urdf"``.
    """
    build: Annotated[
        Callable[[Any, int], Any] | None, option("scene", snapshot="versioned_build")
    ] = None
    """Function ``build(scene, env)`` that adds user content to the ``sapien.Scene`` of each env.
    Visuals and lights are ignored, so code that was written for a screen runs unchanged. It may
    return the entities that :meth:`batchpid.sim.Runner.poses` reports. A reset returns the content
    to the poses that ``build`` gave it.
    """
    on_fault: Annotated[FaultAction, option("snapshot")] = "hold"
    """Action when an env fails: ``"hold"`` (default) keeps it at rest in its last valid state, with
    ``ok`` False until it is reset; ``"reset"`` returns it to its last start, with ``ok`` False for
    that tick. An env fails when its state, or the effort of a :class:`Controller`, is not finite,
    when a position is beyond 1e6 rad or m, or by ``speed_limit``. The other envs are not
    affected.
    """
    speed_limit: Annotated[ArrayLike | None, option("snapshot")] = None
    """Joint speed at which an env fails, scalar or (dof,) [rad/s or m/s]; default none."""
    actuators: Annotated[bp.Actuators | None, option(role="restored")] = None
    """Delays, limits, friction and errors of motors and sensors: :func:`batchpid.make_actuators`,
    of one row, or one row per env. None, the default, selects the robot's actuators; control
    "drive" uses only their friction and armature. ``bp.Actuators()`` is ideal. The control gets
    measured positions and velocities. Observations hold the true ones, and the delivered effort.
    """
    randomization: Annotated[
        Randomization | None, option(snapshot="distributions", recording="distributions")
    ] = None
    """Distributions from which payload, masses, friction, gains and more are drawn for each env and
    episode (docs/randomization.md); default none.
    """
    guard: Annotated[bool | bp.Guard | None, option(snapshot="guard_digest")] = None
    """Limits of setpoints, applied at every sim step: True for :meth:`batchpid.sim.Robot.guard`, or
    :func:`batchpid.make_guard`; default none. ``obs.guarded`` is True where a setpoint was
    changed.
    """
    on_invalid_input: Annotated[InvalidInputAction, option(role="next commands")] = "raise"
    """Response to NaN or infinity in a command or in a pose to reset to: ``"raise"`` (default)
    raises an error, and ``"contain"`` lets only the env concerned fail.
    """
    timeout: Annotated[float, Field("seconds", low=1e-3, high=1e9), option(role="processes")] = 60.0
    """Time [s], beyond an upper bound of the work's duration, after which a worker counts as stuck,
    and is replaced; default 60.
    """
    cluster: Annotated[
        Literal["ray"] | Ray | None,
        option(
            role="processes",
        ),
    ] = None
    """``"ray"`` or :class:`batchpid.sim.Ray`: the workers run on the machines of a Ray cluster,
    with bit-identical results (docs/reliability.md).
    """

    def __post_init__(self) -> None:
        """Convert plain options to their declared type, and check their bounds."""
        for each in fields(self):
            object.__setattr__(self, each.name, checked_option(each.name, getattr(self, each.name)))


OPTIONS = declared(RunnerKeywords, Option)
"""Where each argument is kept and shown."""
KINDS: dict[str, Kind] = get_type_hints(RunnerKeywords, include_extras=True)
"""Declared type of each argument, with its bounds."""


def checked_option(name: str, value: Any) -> Any:
    """Return the value of an argument in the canonical form of its declared type.

    Raises InvalidArgumentError if a number is out of bounds, or the value is of another type.
    """
    return plain(name, KINDS[name], value)


def arguments_of(
    record: Callable[P, object],
) -> Callable[[Callable[..., None]], Callable[Concatenate[Any, P], None]]:
    """Decorate an ``__init__`` that forwards its arguments to ``record``, so that editors show that
    signature.
    """
    return lambda init: init
