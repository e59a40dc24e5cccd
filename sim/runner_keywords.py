"""Arguments of a Runner: the record in which each is declared once.

An option has its type, default, bounds and documentation here, the places that keep it, and the help of its flag. From
this record come the signature of :class:`batchpid.sim.Runner`, the checks of plain numbers, bools and choices, the
values that snapshots, recordings and scenes keep, and the flags of the command line. Checks of options that depend on
the robot or on each other are in :mod:`batchpid.sim.options`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from importlib.util import find_spec
from typing import Annotated, Any, Concatenate, Literal, NamedTuple, ParamSpec, Protocol, get_type_hints

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
    """Controller of the caller's own, for the option ``control``; arrays are (envs, dof), in SAPIEN's order, SI units.

    It is called at every sim step, in the worker processes, for some of the envs at a time: the effort of an env must
    depend on its own rows alone. It travels to the workers by cloudpickle, and may call NumPy or a jitted function.

    A setpoint has a number for each joint, unless the controller has an attribute ``command``: a
    :class:`batchpid.sim.CommandSpec`, or a sequence of names, such as ``("x", "y")``. Then it is (envs, size).
    """

    def init(self, robot: Robot, num_envs: int) -> Any:
        """Return the state of ``num_envs`` envs at their start: None, an array, or tuples and dicts of these.

        Every array has the envs as its first axis: states are reset by mask, and kept in snapshots. Later states have
        the same structure, shapes and dtypes.
        """

    def __call__(
        self,
        state: Any,
        setpoint: Rows,
        qpos: Rows,
        qvel: Rows,
        passive: Rows,
    ) -> tuple[Any, Any]:
        """Return the new state, and the joint efforts [N m or N], which the runner clips to the params' limits.

        An env that has failed is given the ``neutral`` setpoint of the command, by default zeros within its bounds.
        ``passive`` is the passive force that the runner's ``compensate`` selects, plus the caller's feedforward. The
        arrays are read-only copies, which the controller may keep.
        """


Compensation = Literal["gravity+coriolis+friction", "gravity+coriolis", "gravity", "none"]
SetpointSpace = Literal["joints", "tool"]
Backend = Literal["numpy", "jax"]
Precision = Literal["float64", "float32"]
EngineName = Literal["sapien", "mujoco"]
DEFAULT_ENGINE: EngineName = "mujoco" if find_spec("sapien") is None else "sapien"
"""SAPIEN where it is installed, which is on Linux with x86-64; elsewhere MuJoCo."""
PhysicsPreset = Literal["accurate", "fast", "free"]
FaultAction = Literal["hold", "reset"]
InvalidInputAction = Literal["raise", "contain"]
Place = Literal["snapshot", "recording", "scene"]
Role = Literal["restored", "processes", "last bits", "next commands"]
"""Reason for which a snapshot may be restored in a runner with another value of an option.

- "restored": the snapshot holds the value, and the runner takes it over;
- "processes": the value says where and how fast the envs run, and results are bit-identical for any;
- "last bits": so, but the last bits of results differ;
- "next commands": the value is a default of the commands to come (``substeps``), or says which of them are refused.
"""


class Option(NamedTuple):
    """Where an argument of a Runner is kept and shown, by :func:`option`."""

    kept: Mapping[str, str]
    """Places, with the attribute of :class:`batchpid.sim.RunnerOptions` that each of them keeps, "" for the argument's
    own."""
    role: Role | None
    """Role of an argument that a snapshot does not hold against the runner that restores it."""
    flag: str
    """Help of the flag of this name, which `batchpid rollout` has; "" for none."""


def option(*kept: Place, role: Role | None = None, flag: str = "", **kept_as: str) -> Option:
    """Return the option that the places ``kept`` have; those of ``kept_as`` keep another attribute in its place."""
    return Option(dict.fromkeys(kept, "") | kept_as, role, flag)


@dataclass(frozen=True, eq=False, kw_only=True)
class RunnerKeywords:
    """Arguments of a :class:`batchpid.sim.Runner`, as they are passed; all but the first two may be left out.

    A snapshot and the runner that restores it must agree in the options that snapshots keep.
    """

    robot: Annotated[Robot, option(snapshot="robot_name")] = field(kw_only=False)
    """From :meth:`batchpid.sim.Robot.load`."""
    num_envs: Annotated[int, Field(low=1, high=1_000_000), option("snapshot")] = field(kw_only=False)
    """Number of robots, one in each scene."""
    params: Annotated[bp.PIDParams | None, option(role="restored")] = None
    """PID parameters of one row, or one row per env. Default: see :func:`batchpid.sim.options.default_params`."""

    first_env: Annotated[int, Field(high=1e9), option("snapshot")] = 0
    """Number of the first env; default 0. A runner with 100 for it is bit-identical to the envs from 100 on of a larger
    one: the noise of sensors, the streams of a randomization and ``build`` go by the numbers of envs."""
    workers: Annotated[
        int | None,
        Field(high=1024),
        option(role="processes", flag="Processes that step the scenes; 0: this one. Default: one per available core."),
    ] = None
    """Processes that step the scenes; 0 runs the same code in this process. Default: one per available core, each
    pinned to its core. Results are bit-identical for any number of workers."""
    timestep: Annotated[
        float, Field("seconds, not a rate: 1/2000", low=1e-6, high=0.1), option("snapshot", "recording", "scene")
    ] = 1 / 2000
    """Time step of simulation and control [s]; default 1/2000."""
    substeps: Annotated[int, Field(low=1, high=1_000_000), option("recording", role="next commands")] = 20
    """Sim steps of one tick, all under the same setpoint; the control runs at every one of them. Default 20."""
    control: Annotated[
        ControlMode | Literal["osc"] | Controller, option(snapshot="control_name", recording="control_name")
    ] = "pid"
    """``"pid"``, the default; ``"drive"``: the engine's internal PD drive, with the params' kp and kd as stiffness and
    damping; ``"effort"``: the setpoint is the joint effort; ``"osc"``: operational-space control of the link ``tool``,
    whose setpoints are poses (7,), a :class:`batchpid.sim.OperationalSpace` with its defaults; or a
    :class:`Controller`."""
    tool: Annotated[str | None, option("snapshot", "recording")] = None
    """Link that control "osc" and ``setpoint_space`` "tool" move; default the last link of the robot's longest
    chain."""
    setpoint_space: Annotated[SetpointSpace, option("snapshot")] = "joints"
    """``"joints"``, the default, or ``"tool"``: under control "pid" or "drive" setpoints are poses (7,) of the link
    ``tool``, position and quaternion (w, x, y, z), or poses and the positions of the joints outside the chain to it.
    Inverse kinematics (:class:`batchpid.sim.tool_space.tool_setpoints.ToolSetpoints`) makes joint setpoints of them,
    which rollouts and recordings hold."""
    backend: Annotated[
        Backend, option("snapshot", flag="Library of the law: NumPy, or JAX, as one program with the steps.")
    ] = "numpy"
    """Library of the law: ``"numpy"``, the default, or ``"jax"``, which runs law and sim steps of a tick as one program
    of XLA on the CPU, and a :class:`Controller` in it (docs/performance.md). Between the two, and between processors,
    the last bits of results differ."""
    dtype: Annotated[Precision, option("snapshot")] = "float64"
    """Floating-point type of the law under backend ``"jax"``: ``"float64"``, the default, or ``"float32"``."""
    compensate: Annotated[
        Compensation, option("snapshot", "recording", flag="Passive force and known friction, added at every sim step.")
    ] = "gravity+coriolis+friction"
    """Passive force, and the known Coulomb friction on the way to the setpoint, added at every sim step.
    ``"gravity+coriolis+friction"``, the default, or a part of it; under control "effort" friction is not
    compensated. On a floating base the passive force is the joints' own share, as if the base were held where it is:
    what the legs carry of the base depends on their contacts, and is left to the law."""
    engine: Annotated[
        EngineName,
        option(
            "scene",
            snapshot="engine_name",
            recording="engine_name",
            flag="Physics engine; mujoco is several times as fast, and its contacts differ.",
        ),
    ] = DEFAULT_ENGINE
    """Physics engine: ``"sapien"``, the reference and the default where it is installed, or ``"mujoco"``, several times
    as fast (docs/two-engines.md)."""
    physics: Annotated[
        PhysicsPreset | Physics | MujocoSolver,
        option(
            snapshot="solver_settings",
            recording="physics_name",
            scene="solver",
            flag="Solver settings: SAPIEN's, fewer iterations, or one, for motion without contact.",
        ),
    ] = "accurate"
    """``"accurate"`` (the default: SAPIEN's solver settings), ``"fast"``, ``"free"`` (for motion without contact), or a
    :class:`batchpid.sim.Physics`, with the engine MuJoCo a :class:`batchpid.sim.MujocoSolver`."""
    collisions: Annotated[
        bool,
        option("snapshot", "recording", "scene", flag="Robots have no collision shapes: faster, for free motion only."),
    ] = True
    """Robots have collision shapes; default True. With False they have none, and there is no ground: for free motion
    only. Masses, inertias and joint limits stay. A :class:`batchpid.sim.MissedContactWarning` says which robots would
    have touched something."""
    ground: Annotated[
        bool | None,
        option(
            "snapshot",
            "recording",
            "scene",
            flag="Ground at height 0. Default: on, unless links of a fixed robot reach it at the start pose.",
        ),
    ] = None
    """Add a ground plane at height 0 to every scene; default :attr:`Robot.has_ground`: unless the robot's base is fixed
    so low that other links reach the ground at its start pose. With engine "mujoco" the planes in the world of an MJCF
    file take its place, by default as in the file."""
    contacts: Annotated[Sequence[str] | None, option("snapshot", "recording", "scene")] = None
    """Links whose contact forces are observed: ``obs.contact_force`` and ``obs.touching``. Links that fixed joints join
    are one body, and count as one. Default none. The links must move; with SAPIEN the robot has
    ``dissipation="urdf"``."""
    wrenches: Annotated[Sequence[str] | None, option("snapshot", "recording", "scene")] = None
    """Links with a sensor of the force and torque that the parent exerts on the link: ``obs.wrench``. Default none. A
    link that a fixed joint holds needs a robot with ``merge_fixed=False``."""
    build: Annotated[Callable[[Any, int], Any] | None, option("scene", snapshot="build_digest")] = None
    """``build(scene, env)`` adds user content to the ``sapien.Scene`` of each env. Visuals and lights are left out, so
    that code written for a screen runs unchanged. It may return the entities that :meth:`batchpid.sim.Runner.poses`
    reports. A reset puts the content back to where ``build`` left it."""
    on_fault: Annotated[FaultAction, option("snapshot")] = "hold"
    """``"hold"`` (the default) an env that fails at rest in its last valid state, with ``ok`` False until it is reset;
    or ``"reset"`` it to its last start, with ``ok`` False for that tick. An env fails when its state is not finite,
    when a position is beyond 1e6 rad or m, or by ``speed_limit``. The other envs are not affected."""
    speed_limit: Annotated[ArrayLike | None, option("snapshot")] = None
    """Joint speed at which an env fails, scalar or (dof,) [rad/s or m/s]; default none."""
    actuators: Annotated[bp.Actuators | None, option(role="restored")] = None
    """Delays, limits, friction and errors of motors and sensors: :func:`batchpid.make_actuators`, of one row, or one
    row per env. None, the default, selects the robot's actuators: under control "drive" their friction and
    armature. ``bp.Actuators()`` is ideal. The control sees measured positions and velocities; observations hold the
    true ones, and the effort that was delivered."""
    randomization: Annotated[Randomization | None, option(snapshot="distributions", recording="distributions")] = None
    """Distributions from which payload, masses, friction, gains and more are drawn for each env and episode
    (docs/randomization.md); default none."""
    guard: Annotated[bool | bp.Guard | None, option(snapshot="guard_digest")] = None
    """Limits of setpoints, applied at every sim step: True for :meth:`batchpid.sim.Robot.guard`, or
    :func:`batchpid.make_guard`; default none. ``obs.guarded`` tells which setpoints were changed."""
    on_invalid_input: Annotated[InvalidInputAction, option(role="next commands")] = "raise"
    """``"raise"`` (the default) an error for NaN or infinity in a command or in a pose to reset to, or ``"contain"``
    it: only the env concerned fails."""
    recover: Annotated[bool, option(role="processes")] = True
    """Replace a worker process that dies or gets stuck, and replay its envs; default True: results are bit-identical to
    an undisturbed run. With False :class:`batchpid.errors.WorkerError` is raised."""
    checkpoint_steps: Annotated[int | None, Field(low=1, high=1e9), option(role="last bits")] = 8000
    """Sim steps between checkpoints, from which a replay starts, by default 8000; None: one replay from the start, for
    which all commands are kept. After contacts the last bits of the results depend on it."""
    timeout: Annotated[float, Field("seconds", low=1e-3, high=1e9), option(role="processes")] = 60.0
    """Seconds, by default 60, beyond an upper bound of the time that its work takes, before a worker counts as stuck. A
    worker that is stopped or asleep within a tick counts as stuck within a second."""
    cluster: Annotated[
        Literal["ray"] | Ray | None,
        option(
            role="processes",
            flag="Run on a Ray cluster: that of RAY_ADDRESS, else of this machine (extra `ray`; docs/cluster.md).",
        ),
    ] = None
    """``"ray"`` or :class:`batchpid.sim.Ray`: the workers run on the machines of a Ray cluster, with bit-identical
    results (docs/cluster.md)."""

    def __post_init__(self) -> None:
        """Bring plain options to their declared type, within their bounds."""
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


def arguments_of(record: Callable[P, object]) -> Callable[[Callable[..., None]], Callable[Concatenate[Any, P], None]]:
    """Decorate an ``__init__`` that passes its arguments on to ``record``, for editors to show those of ``record``."""
    return lambda init: init
