"""Robot: a URDF or MJCF file, parsed once: joints, limits and defaults, checks and gains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

import batchpid as bp
from batchpid.arrays.array_types import CHOICES, Bool, Document, Float64
from batchpid.arrays.elementwise import read_only
from batchpid.checks import check_keywords, choice, file_path, flag
from batchpid.errors import InvalidArgumentError, RobotError
from batchpid.motors.coupling import Coupling
from batchpid.sim.description import reading
from batchpid.sim.description.merging import couple, coupling_of, place_links
from batchpid.sim.description.tables import Joint, MjcfFile, Placement, Settings, Source, Tables
from batchpid.sim.diagnosis.preflight import check
from batchpid.sim.findings import Finding, Findings, report
from batchpid.sim.robot.robot_model import (
    RobotModel,
    SelfContact,
    free_target,
    link_tree,
    model_of,
    self_contact,
    suggested_effort_limit,
)
from batchpid.sim.robot.robot_options import (
    engine_findings,
    load_robot_actuators,
    setpoint_guard,
    tuned_file,
)
from batchpid.task_space.rigid_tree import RigidTree

DESIGN_HZ = 1.7
"""Bandwidth of :meth:`Robot.designed` with the mass matrix."""
STANDING_HZ = 3.0
"""Bandwidth of :meth:`Robot.designed` for a robot that stands: its weight sinks by about g / (2 pi
STANDING_HZ)^2.
"""


@dataclass(
    frozen=True,
    eq=False,
    repr=False,
)
class Robot:
    """Robot as its file describes it; every array is in the order of ``joint_names``. Load one with
    :meth:`load`.

    ``source`` is what the reader found. ``joints`` are the degrees of freedom, the joints of
    ``tables`` that move, with limits, friction and damping of followers moved to their leaders.
    ``settings`` come from a bundled robot, else None. ``actuators`` are its motors and sensors, None
    for ideal ones.
    """

    source: Source
    joints: tuple[Joint, ...]
    settings: Settings | None
    actuators: bp.Actuators | None = None

    def __repr__(self) -> str:
        return f"Robot({self.name!r}, {self.dof} dof, path={str(self.path)!r})"

    @property
    def name(self) -> str:
        """Name in the file, else the file's."""
        return self.source.name

    @property
    def path(self) -> Path:
        """Path of the file."""
        return self.source.path

    @property
    def tables(self) -> Tables:
        """Bodies, shapes and visuals as in the file, after the repairs."""
        return self.source.tables

    @property
    def repairs(self) -> tuple[Finding, ...]:
        """Findings of reading the file."""
        return self.source.repairs

    @property
    def fixed_base(self) -> bool:
        """False if the base floats."""
        return self.source.fixed_base

    @property
    def mjcf(self) -> MjcfFile | None:
        """MJCF file that MuJoCo simulates, None for a URDF."""
        return self.source.mjcf

    @cached_property
    def bodies(self) -> Mapping[str, Placement]:
        """Placement of every link in its simulated body: links joined by fixed joints are one."""
        return place_links(self.tables)

    @property
    def dof(self) -> int:
        """Number of degrees of freedom."""
        return len(self.joints)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the degrees of freedom, in breadth-first order, as in SAPIEN."""
        return tuple(joint.name for joint in self.joints)

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the positions, "rad" or "m"."""
        return tuple(joint.unit for joint in self.joints)

    @property
    def lower(self) -> Float64:
        """Lower position limits (dof,) [rad or m]."""
        return self._column("lower")

    @property
    def upper(self) -> Float64:
        """Upper position limits (dof,) [rad or m]."""
        return self._column("upper")

    @property
    def effort_limit(self) -> Float64:
        """Effort limits (dof,) [N m or N], infinite where the URDF gives none."""
        return self._column("effort_limit")

    @cached_property
    def design_effort_limit(self) -> Float64:
        """Effort limits (dof,) [N m or N] of designed and tuned gains: stated, or suggested ones."""
        limits = self.effort_limit
        # The dynamics of 50 poses take time that most robots need not spend.
        if np.isfinite(limits).all():
            return read_only(limits)
        return read_only(np.where(np.isfinite(limits), limits, suggested_effort_limit(self)))

    @property
    def velocity_limit(self) -> Float64:
        """Velocity limits (dof,) [rad/s or m/s], infinite where the URDF gives none."""
        return self._column("velocity_limit")

    @property
    def continuous(self) -> Bool:
        """Mask (dof,) of the joints whose position wraps at a full turn."""
        return self._column("continuous")

    @property
    def damping(self) -> Float64:
        """Viscous damping of the joints (dof,) [N m s/rad or N s/m]."""
        return self._column("damping")

    @property
    def friction(self) -> Float64:
        """Coulomb friction of the joints (dof,) [N m or N]; 0 with ``dissipation`` "sapien"."""
        return self._column("friction") * (self.source.dissipation == "urdf")

    def _column(self, name: str) -> np.ndarray:
        return np.array([getattr(joint, name) for joint in self.joints])

    @cached_property
    def coupling(self) -> Coupling:
        """Coupling of the mimic joints to their leaders; the identity without mimic joints."""
        return coupling_of(self.joints)

    @property
    def independent(self) -> Bool:
        """Mask (dof,) of the joints that are not followers."""
        return self.coupling.independent

    @property
    def start(self) -> Float64:
        """Start pose (dof,) [rad or m]: the bundled settings', the file's, or zero, in the limits."""
        if self.settings is not None:
            return self.settings.start.copy()
        start = self.source.start
        pose = np.clip(0.0 if start is None else start, self.lower, self.upper)
        coupled: Float64 = self.coupling.positions(pose)
        return coupled

    @property
    def target(self) -> Float64:
        """Pose (dof,) [rad or m] for a first move, within the limits.

        The target of the bundled settings. Else a quarter of the way from the start to the farther
        limit of each joint, at most 0.5 rad or m; a part of it, or of the way back, where links
        would touch each other or the ground.
        """
        if self.settings is not None:
            return self.settings.target.copy()
        return free_target(self).copy()

    def params(self, **options: Any) -> bp.PIDParams:
        """Return PID parameters for this robot: :func:`batchpid.make_params` with the robot's
        values filled in.

        Effort limits and continuous joints come from the URDF and, for a bundled robot, kp, ki and
        kd from its settings; anti-windup is "conditional". ``options`` override these and add
        others. Raises InvalidArgumentError if there is no ``kp``.
        """
        defaults: Document = {"joint_names": self.joint_names, "anti_windup": "conditional"}
        if self.continuous.any():
            defaults["continuous"] = self.continuous
        if not {"effort_min", "effort_max"} & set(options):
            defaults["effort_limit"] = self.effort_limit
        if self.settings is not None:
            defaults |= {gain: getattr(self.settings, gain) for gain in ("kp", "ki", "kd")}
        elif "kp" not in options:
            remedy = "pass kp=, ki=, kd= (scalar or per joint), or use robot.designed()"
            raise InvalidArgumentError("kp", f"robot {self.name!r} has no gains", remedy=remedy)
        return bp.make_params(joints=self.dof, **(defaults | options))

    def sample(self, count: int, seed: int = 0) -> Float64:
        """Return seeded poses (count, dof), uniform within the limits and half a turn of the start."""
        # A joint without limits would have no range to draw from.
        low = np.maximum(self.lower, self.start - np.pi)
        high = np.minimum(self.upper, self.start + np.pi)
        poses = np.random.default_rng(seed).uniform(low, high, (count, self.dof))
        coupled: Float64 = self.coupling.positions(poses)
        return coupled

    def mass_matrix(self, qpos: ArrayLike) -> Float64:
        """Return the mass matrices (n, dof, dof) [kg m^2 or kg] at ``qpos`` (n, dof), base fixed."""
        return self.dynamics().mass_matrix(np.atleast_2d(np.asarray(qpos, np.float64)))

    def dynamics(self, ground: bool | None = None) -> RobotModel:
        """Return mass matrix, inverse and forward dynamics and contact of this robot on a fixed
        base. ``ground``: whether there is a ground at height 0; default :attr:`has_ground`.
        """
        has_ground = self.has_ground if ground is None else ground
        return model_of(self, has_ground)

    @cached_property
    def self_contact(self) -> SelfContact:
        """Pairs of links that do not collide, and contact with the ground."""
        return self_contact(self)

    @property
    def has_ground(self) -> bool:
        """True if scenes have a ground by default; False if links of a fixed base start in it."""
        return not self.self_contact.reaches_ground

    @classmethod
    def load(
        cls,
        name_or_path: str | Path,
        *,
        package_dirs: Sequence[str | Path] = (),
        dissipation: str = "urdf",
        fixed_base: bool | None = None,
        self_collision: str = "auto",
        actuators: bp.Actuators | str | Path | None = None,
        strict: bool = False,
    ) -> Robot:
        """Load a bundled robot by name (:meth:`bundled`), or any URDF or MJCF file by path.

        Parameters
        ----------
        package_dirs
            Folders in which ``package://`` mesh paths are looked up first.
        dissipation
            ``"urdf"``: joint friction and damping as the URDF says, by the model of
            :mod:`batchpid.motors.friction`. ``"sapien"``: SAPIEN's defaults, PhysX's joint friction
            0.05 and link damping 0.05, for comparison with its tutorial.
        fixed_base
            True to fix the root link to the world. Default True, unless the root of an MJCF file has
            a free joint, or the root of a URDF is a link without mass and shapes whose only joint is
            floating: then the root is that joint's child.
        self_collision
            ``"auto"``: links that are neighbours, or touch or overlap at the start pose or in
            nearly every sampled pose do not collide (:attr:`self_contact`). ``"urdf"``: all links
            collide. An .srdf next to the URDF, of the same name, disables and enables further
            pairs. ``"none"``: no link collides with another.
        actuators
            Motors and sensors that runners of this robot have by default:
            :class:`batchpid.Actuators` of one row, or a file of :func:`batchpid.save_actuators`.
            None: ideal ones, with the armature of an MJCF file.
        strict
            True to refuse a file that needs repairs that change the motion; otherwise a warning
            counts them, and :meth:`check` lists them.

        Raises
        ------
        RobotNotFoundError
            No bundled robot and no file of that name.
        RobotError
            The file is no usable URDF or MJCF file, or, with ``strict``, it needs repairs.
        """
        choice("dissipation", dissipation, ("urdf", "sapien"))
        choice("self_collision", self_collision, ("auto", "urdf", "none"))
        fixed_base = None if fixed_base is None else flag("fixed_base", fixed_base)
        strict = flag("strict", strict)
        if not isinstance(package_dirs, list | tuple):
            problem = "must be a list"
            raise InvalidArgumentError("package_dirs", problem, remedy="pass a list of folders")
        # A wrong option is not hidden by a fault of the file.
        path = reading.find_robot(name_or_path)
        folders = tuple(file_path("package_dirs", folder) for folder in package_dirs)
        source = reading.read_robot(path, fixed_base, folders)
        report(path, source.repairs, strict)
        moving = [joint for joint in source.tables.joints if joint.moves]
        if not moving:
            raise RobotError(
                f"{path}: a robot without moving joints cannot be controlled; check the joint types"
            )
        joints = couple(moving)
        source = reading.with_srdf(source)
        source = source._replace(self_collision=self_collision, dissipation=dissipation)
        robot = cls(source, joints, reading.read_settings(path, joints))
        motors = source.actuators if actuators is None else actuators
        if motors is None:
            return robot
        return replace(robot, actuators=load_robot_actuators(motors, robot))

    @staticmethod
    def bundled() -> tuple[str, ...]:
        """Return the names of the robots that ship with batchpid."""
        return reading.bundled_robots()

    def check(
        self,
        *,
        params: bp.PIDParams | None = None,
        qpos: ArrayLike | None = None,
        setpoint: ArrayLike | None = None,
        timestep: float = 1 / 2000,
        control: str = "pid",
        engine: str | None = None,
    ) -> Findings:
        """Return the findings of the preflight, most severe first: oddities of robot and run.

        Parameters
        ----------
        params
            PID parameters to check, too; default :meth:`params` of a bundled robot.
        qpos, setpoint
            Start pose (default :attr:`start`) and setpoint (default: none), (dof,) [rad or m].
        timestep, control
            As in :class:`batchpid.sim.Runner`: ``"pid"``, ``"drive"`` or ``"effort"``.
        engine
            ``"mujoco"`` or ``"sapien"``: add what this engine cannot run, and what it runs
            otherwise than the file says.
        """
        if params is None and self.settings is not None and control == "pid":
            params = self.params()
        of_engine = engine_findings(self, engine, timestep)
        return check(
            self,
            params,
            qpos,
            setpoint,
            timestep,
            control,
            of_engine,
        )

    def guard(
        self, *, rate: ArrayLike | None = None, acceleration: ArrayLike | None = None
    ) -> bp.Guard:
        """Return the limits of setpoints: positions, and soft limits of ``safety_controller``, as
        in the URDF. Followers have none: they move with their leaders.

        ``rate`` [rad/s or m/s] and ``acceleration`` [rad/s^2 or m/s^2] are scalars or (dof,), by
        default the URDF's limits of velocity, and of acceleration or deceleration (URDF 1.2), the
        smaller of both.
        """
        return setpoint_guard(self.joints, rate, acceleration)

    def designed(self, gain_units: str | None = None) -> bp.PIDParams:
        """Return params designed from the robot's inertia alone; a search for gains starts from
        them.

        With the mass matrix the poles lie between the poles of Bessel's prototype s^3 + 6 s^2 + 15
        s + 15 (W. E. Thomson, "Delay networks having maximally flat frequency characteristics",
        Proc. IEE 96, 1949), with zeta = sqrt(0.6) and Ti = sqrt(15) / w, and three equal ones. A
        step settles in 0.91 s with 0.1 % overshoot, at two thirds of the effort that three equal
        poles of that speed need. In other units the joints disturb each other, which three equal
        poles tolerate better.

        ``gain_units`` are "mass_matrix" or "effort" (:mod:`batchpid.law.computed_torque`). Default
        "mass_matrix"; on a floating base "effort", for legs that carry the base at the start pose:
        the mass matrix is that of legs in the air, a twentieth. Raises InvalidArgumentError for a
        mass matrix that is not positive definite.
        """
        if gain_units is None:
            gain_units = "mass_matrix" if self.fixed_base else "effort"
        choice("gain_units", gain_units, CHOICES["gain_units"])
        options: Document = {"gain_units": gain_units, "measurement_rate": "measured"}
        if gain_units == "effort" and not self.fixed_base:
            load = self.dynamics().standing_inertia(self.start)
            return bp.design_gains(self, STANDING_HZ, load=load, **options)
        if gain_units != "mass_matrix":
            return bp.design_gains(self, 2.25, **options)
        time = 4.5 / (2 * np.pi * DESIGN_HZ)
        return bp.design_gains(self, DESIGN_HZ, 0.82, integral_time=time, **options)

    def kinematic_tree(self, **options: ArrayLike) -> RigidTree:
        """Return the kinematic tree of this robot, for :mod:`batchpid.task_space`, in float64.

        It has every link of the file by name, merged ones included. Followers move with their
        leaders. It has no friction and damping.

        ``options`` are ``armature`` (dof,) [kg m^2 or kg], by default the one in :attr:`actuators`,
        and ``gravity`` (3,) [m/s^2]. Raises RobotError if the base is not fixed, or a mesh cannot be
        read of a link whose mass comes from its collision shapes.
        """
        check_keywords("kinematic_tree", options, ("armature", "gravity"))
        own_options = {}
        if self.actuators is not None and self.actuators.armature is not None:
            own_options["armature"] = np.asarray(self.actuators.armature, float)[0]
        if not self.fixed_base:
            problem = f"{self.path}: a kinematic tree needs a robot with a fixed base"
            raise RobotError(f"{problem}; load it with fixed_base=True, or control its joints")
        return replace(link_tree(self), **(own_options | options))

    def tuned(self) -> bp.PIDParams:
        """Return the tuned params of a bundled robot; see docs/choosing-gains.md. Raises
        InvalidArgumentError for another robot.
        """
        file = tuned_file(self)
        if file is None:
            remedy = "use robot.designed(), or search for gains with: batchpid tune"
            raise InvalidArgumentError("robot", f"{self.name!r} has no tuned gains", remedy=remedy)
        return bp.load_params(file, self.joint_names)[0]

    def mjcf_gains(self) -> bp.PIDParams:
        """Return params with the gains of the servos of an MJCF file: kp and kd, on the measured
        velocity.

        Joints without servo have gains of 0; a velocity servo has kd alone. The setpoint is a
        joint's position. :meth:`guard` has its limits. Raises InvalidArgumentError without servos.
        """
        gains = self.source.gains
        if gains is None:
            problem = f"{self.name!r} has no servos of an MJCF file"
            raise InvalidArgumentError("robot", problem, remedy="use robot.designed()")
        return self.params(**gains, measurement_rate="measured")
