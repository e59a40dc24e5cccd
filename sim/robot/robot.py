"""Robot: a URDF or MJCF file, parsed once and checked, for headless simulation."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

import batchpid as bp
from batchpid import assets
from batchpid.arrays.array_types import Document
from batchpid.arrays.choices import CHOICES
from batchpid.arrays.elementwise import read_only
from batchpid.checks.validate import check_keywords, choice, file_path, flag
from batchpid.errors import InvalidArgumentError, RobotError, RobotNotFoundError
from batchpid.sim.findings import Finding, Findings, report
from batchpid.sim.robot.description import RobotDescription
from batchpid.sim.robot.mimics import couple
from batchpid.sim.robot.parts import DISSIPATION, Joint, Settings
from batchpid.sim.robot.robot_options import load_robot_actuators, setpoint_guard
from batchpid.sim.robot.self_collision import SELF_COLLISION, Srdf, read_srdf
from batchpid.sim.robot.urdf import read_robot
from batchpid.task_space.rigid_tree import RigidTree

_ASSETS = Path(assets.__file__).parent
DESIGN_HZ = 1.7
"""Bandwidth of :meth:`Robot.designed` with the mass matrix."""
STANDING_HZ = 3.0
"""Bandwidth of :meth:`Robot.designed` for a robot that stands: its weight sinks by about g / (2 pi
STANDING_HZ)^2.
"""


@dataclass(frozen=True, eq=False, repr=False)
class Robot(RobotDescription):
    """Robot description, with its checks and gains. Load one with :meth:`load`."""

    @classmethod
    def load(
        cls,
        name_or_path: str | Path,
        *,
        package_dirs: Sequence[str | Path] = (),
        missing_meshes: str = "skip",
        dissipation: str = "urdf",
        fixed_base: bool | None = None,
        self_collision: str = "auto",
        actuators: bp.Actuators | str | Path | None = None,
        strict: bool = False,
    ) -> Robot:
        """Load a bundled robot by name (``Robot.bundled()``), or any URDF or MJCF file by path.

        Parameters
        ----------
        package_dirs
            Folders in which ``package://`` mesh paths are looked up first.
        missing_meshes
            ``"skip"`` to leave out collision shapes whose mesh is missing or cannot be read, or
            ``"error"``.
        dissipation
            ``"urdf"``: joint friction and damping as the URDF says, in N m and N m s/rad, by the
            model of :mod:`batchpid.motors.friction`; no link damping. ``"sapien"``: SAPIEN's
            defaults, PhysX's joint friction 0.05 and link damping 0.05, for comparison with its
            tutorial.
        fixed_base
            True to fix the root link to the world. Default True, unless the file has a floating
            base: the root of an MJCF file has a free joint, or the root of a URDF is a link without
            mass and shapes and its only joint is floating: then the root is that joint's
            child.
        self_collision
            ``"auto"``: links that are neighbours, or touch or overlap at the start pose or in
            nearly every sampled pose do not collide (:attr:`self_contact`). ``"urdf"``: all links
            collide. An .srdf next to the URDF, of the same name, disables and enables further
            pairs. ``"none"``: no link collides with another.
        actuators
            Motors and sensors that runners of this robot have by default:
            :class:`batchpid.Actuators` of one row, or a file of :func:`batchpid.save_actuators`, in
            which joints are matched by name. None: ideal ones, with the armature of an MJCF file.
        strict
            True to refuse a file that needs repairs that change the motion, which are otherwise
            made, with a warning, and listed by :meth:`check`.

        Raises
        ------
        RobotNotFoundError
            No bundled robot and no file of that name.
        RobotError
            The file is neither a usable URDF nor a usable MJCF file; the message names the element
            and the remedy. With ``strict``, it needs repairs, which the message lists.
        InvalidArgumentError
            An option has none of the values above.
        """
        choice("missing_meshes", missing_meshes, ("error", "skip"))
        choice("dissipation", dissipation, DISSIPATION)
        choice("self_collision", self_collision, SELF_COLLISION)
        fixed_base = None if fixed_base is None else flag("fixed_base", fixed_base)
        strict = flag("strict", strict)
        if not isinstance(package_dirs, list | tuple):
            problem = "must be a list of folders"
            raise InvalidArgumentError(
                "package_dirs", problem, value=package_dirs, remedy="pass a list of paths"
            )
        # Options are checked before a file is read, so that a wrong one is not hidden by a fault of
        # the file.
        path = _find(name_or_path)
        folders = tuple(file_path("package_dirs", folder) for folder in package_dirs)
        source = read_robot(path, fixed_base, folders, missing_meshes)
        report(path, source.repairs, strict)
        joints = couple([joint for joint in source.tables.joints if joint.moves])
        if not joints:
            raise RobotError(
                f"{path}: a robot without moving joints cannot be controlled; check the joint types"
            )
        beside = path.with_suffix(".srdf")
        srdf = Srdf()
        if os.path.isfile(beside):
            srdf = read_srdf(beside, source.tables.links)
        fields = source._asdict()
        srdf = srdf._replace(disabled=(*fields.pop("pairs"), *srdf.disabled))
        bundled = path.parent == _ASSETS
        robot = cls(
            **fields,
            path=path,
            srdf=srdf,
            self_collision=self_collision,
            joints=joints,
            dissipation=dissipation,
            package_dirs=folders,
            settings=_read_settings(path.with_suffix(".yaml"), joints) if bundled else None,
        )
        motors = source.actuators if actuators is None else actuators
        if motors is None:
            return robot
        return replace(robot, actuators=load_robot_actuators(motors, robot))

    @staticmethod
    def bundled() -> tuple[str, ...]:
        """Return the names of the robots that ship with batchpid."""
        return tuple(sorted(path.stem for path in _ASSETS.glob("*.urdf")))

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
        """Return the findings of the preflight, most severe first: oddities of this robot and of
        running it this way.

        Parameters
        ----------
        params
            PID parameters to check, too; default :meth:`params` if the robot has gains.
        qpos, setpoint
            Start pose (default :attr:`start`) and setpoint (default: none) to check, (dof,) [rad or
            m].
        timestep
            Time step of control and simulation [s].
        control
            ``"pid"``, ``"drive"`` or ``"effort"``, as in :class:`batchpid.sim.Runner`.
        engine
            ``"mujoco"`` or ``"sapien"``: add what this engine cannot run, and what it runs
            otherwise than the file says. None: findings that hold in every engine.

        Raises
        ------
        InvalidArgumentError
            An argument has a wrong shape, type or range.
        """
        from batchpid.sim.diagnosis.preflight import check

        if params is None and self.settings is not None and control == "pid":
            params = self.params()
        of_engine: Iterable[Finding] = ()
        if engine is not None:
            # The one import that leads upwards: an engine knows robots, and is asked by its name.
            from batchpid.sim.engine.protocol import engine_findings

            of_engine = engine_findings(self, engine, timestep)
        return check(self, params, qpos, setpoint, timestep, control, of_engine)

    def guard(
        self, *, rate: ArrayLike | None = None, acceleration: ArrayLike | None = None
    ) -> bp.Guard:
        """Return the limits of setpoints: positions, and soft limits of ``safety_controller``, as
        in the URDF.

        Followers have none: they move with their leaders.

        Parameters
        ----------
        rate
            Largest rate, scalar or (dof,) [rad/s or m/s]; default the URDF's velocity limits.
        acceleration
            Largest acceleration, scalar or (dof,) [rad/s^2 or m/s^2]; default the URDF's limits of
            acceleration and deceleration (URDF 1.2), the smaller of both.

        Raises
        ------
        InvalidArgumentError
            A limit is not positive.
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

        Parameters
        ----------
        gain_units
            ``"mass_matrix"`` or ``"effort"``: :mod:`batchpid.law.computed_torque`. Default
            ``"mass_matrix"``; on a floating base ``"effort"``, for legs that carry the base at the
            start pose: the mass matrix is that of legs in the air, a twentieth.

        Raises
        ------
        InvalidArgumentError
            Unknown gain_units, or a mass matrix that is not positive definite.
        """
        chosen = (
            ("mass_matrix" if self.fixed_base else "effort") if gain_units is None else gain_units
        )
        gain_units = choice("gain_units", chosen, CHOICES["gain_units"])
        options: Document = {"gain_units": gain_units, "measurement_rate": "measured"}
        if gain_units == "effort" and not self.fixed_base:
            return bp.design_gains(
                self, STANDING_HZ, load=self.dynamics().standing_inertia(self.start), **options
            )
        if gain_units != "mass_matrix":
            return bp.design_gains(self, 2.25, **options)
        return bp.design_gains(
            self, DESIGN_HZ, 0.82, integral_time=4.5 / (2 * np.pi * DESIGN_HZ), **options
        )

    def kinematic_tree(self, **options: ArrayLike) -> RigidTree:
        """Return the kinematic tree of this robot, for :mod:`batchpid.task_space`, in float64.

        No engine is needed.

        It knows every link of the URDF by name, merged ones included. Followers move with their
        leaders (:attr:`coupling`). It has no friction and damping.

        Parameters
        ----------
        options
            ``armature`` (dof,) [kg m^2 or kg], by default the one in :attr:`actuators`; ``gravity``
            (3,) [m/s^2].

        Raises
        ------
        RobotError
            The base is not fixed, or a mesh cannot be read of a link whose mass comes from its
            collision shapes.
        InvalidArgumentError
            An option is not one of those above, or has a wrong shape or sign.
        """
        check_keywords("kinematic_tree", options, ("armature", "gravity"))
        own_options = {}
        if self.actuators is not None and self.actuators.armature is not None:
            own_options["armature"] = np.asarray(self.actuators.armature, float)[0]
        if not self.fixed_base:
            problem = "operational space and inverse kinematics need a robot with a fixed base"
            raise RobotError(
                f"{self.path}: {problem}; load the robot with fixed_base=True, or control its"
                " joints"
            )
        return replace(self.rigid_tree, **(own_options | options))

    @property
    def has_tuned(self) -> bool:
        """True if tuned params ship with the robot, for :meth:`tuned`."""
        return self.settings is not None and self.path.with_suffix(".tuned.yaml").is_file()

    def tuned(self) -> bp.PIDParams:
        """Return the tuned params of a bundled robot; see docs/choosing-gains.md.

        Raises
        ------
        InvalidArgumentError
            The robot is not bundled.
        """
        if not self.has_tuned:
            remedy = "use robot.designed(), or search for gains with: batchpid tune"
            raise InvalidArgumentError("robot", f"{self.name!r} has no tuned gains", remedy=remedy)
        return bp.load_params(self.path.with_suffix(".tuned.yaml"), self.joint_names)[0]

    def mjcf_gains(self) -> bp.PIDParams:
        """Return params with the gains of the servos of an MJCF file: kp, ki and kd, on the
        measured velocity, and the limits of their integrals.

        Joints without servo have gains of 0. The setpoint is a joint's position, for any unit of
        the servo's control; a velocity servo has kd alone. :meth:`guard` has the limits of their
        setpoints.

        Raises
        ------
        InvalidArgumentError
            The robot is not from an MJCF file, or that has no servos.
        """
        defaults = self.defaults
        if defaults is None or defaults.kp is None:
            problem = (
                f"{self.name!r} has no servos of an MJCF file (<position>, or <general> with an"
                " affine bias)"
            )
            raise InvalidArgumentError("robot", problem, remedy="use robot.designed()")
        gains = {name: getattr(defaults, name) for name in ("kp", "ki", "kd", "integral_limit")}
        # MuJoCo's integral grows during saturation, up to its limit.
        return self.params(**gains, anti_windup="none", measurement_rate="measured")


def _find(name_or_path: str | Path) -> Path:
    path = Path(os.path.expanduser(file_path("name_or_path", name_or_path)))
    if str(name_or_path) in Robot.bundled():
        return _ASSETS / f"{name_or_path}.urdf"
    if os.path.isdir(
        path
    ):  # pathlib's methods raise other errors for names that are too long or start with ~
        raise RobotNotFoundError(f"{path} is a folder; pass the path of a URDF or MJCF file in it")
    if os.path.exists(path):  # also a pipe, such as /dev/stdin
        return path.absolute()
    raise RobotNotFoundError(
        f"no robot {str(name_or_path)!r}: neither bundled ({', '.join(Robot.bundled())}) nor a"
        " file; check the spelling, or pass the path of a URDF or MJCF file"
    )


def _read_settings(path: Path, joints: tuple[Joint, ...]) -> Settings:
    import yaml  # here, so that `batchpid --help` does not load it

    data = yaml.safe_load(path.read_text())
    rows = [data["joints"][joint.name] for joint in joints]
    keys = ("start", "target", "kp", "ki", "kd")
    columns = {key: read_only(np.array([row[key] for row in rows], float)) for key in keys}
    return Settings(
        **columns,
        drive_stiffness=float(data["drive"]["stiffness"]),
        drive_damping=float(data["drive"]["damping"]),
        rate_hz=float(data["rate_hz"]),
        notes=tuple(data.get("notes", ())),
    )
