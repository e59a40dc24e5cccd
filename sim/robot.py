"""Robot: a URDF, parsed once, checked, headless."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml
from lxml import etree
from numpy.typing import ArrayLike, NDArray

import assets
import batchpid as bp
from batchpid.errors import InvalidArgumentError, RobotError, RobotNotFoundError

from .arguments import choice, flag
from .check import Finding, check
from .hostile_xml import parse_xml
from .physics import DISSIPATION, PHYSICS
from .urdf import Joint, Link, read_urdf

if TYPE_CHECKING:
    from .probe import Probe

Float64 = NDArray[np.float64]
_ASSETS = Path(assets.__file__).parent


@dataclass(frozen=True)
class Settings:
    """What a bundled robot carries: its tutorial's poses and gains, in joint order.

    ``start``, ``target``: (dof,) [rad or m]; ``kp``, ``ki``, ``kd``: (dof,) of the PID; ``drive_stiffness`` and
    ``drive_damping`` of PhysX's internal drive; ``rate_hz``: control and simulation rate; ``notes``: where they
    differ from the tutorial's, in words.
    """

    start: Float64
    target: Float64
    kp: Float64
    ki: Float64
    kd: Float64
    drive_stiffness: float
    drive_damping: float
    rate_hz: float
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Robot:
    """A robot description. Load one with :meth:`load`; every array is in the order of ``joint_names``.

    ``joints`` are the degrees of freedom in SAPIEN's order; ``all_joints`` includes the fixed ones.
    ``settings`` is None unless the robot is bundled.
    """

    name: str
    path: Path
    urdf: str
    srdf: str | None
    joints: tuple[Joint, ...]
    all_joints: tuple[Joint, ...]
    links: tuple[Link, ...]
    missing_meshes: tuple[str, ...]
    dissipation: str
    fixed_base: bool
    settings: Settings | None

    @classmethod
    def load(
        cls,
        name_or_path: str | Path,
        *,
        package_dirs: Sequence[str | Path] = (),
        missing_meshes: str = "error",
        dissipation: str = "urdf",
        fixed_base: bool = True,
    ) -> Robot:
        """Load a bundled robot by name (``Robot.bundled()``), or any URDF by path.

        Parameters
        ----------
        package_dirs
            Folders in which ``package://`` mesh paths are looked up first.
        missing_meshes
            ``"error"``, or ``"skip"`` to go on without collision shapes whose mesh is missing.
        dissipation
            ``"urdf"``: joint friction and damping as the URDF says, no link damping. ``"sapien"``: what SAPIEN
            gives unasked, joint friction 0.05 and link damping 0.05, for comparing with its tutorial.
        fixed_base
            Whether the root link is fixed to the world.

        Raises
        ------
        RobotNotFoundError
            No bundled robot and no file of that name.
        RobotError
            The file is no usable URDF; the message names the element and the remedy.
        InvalidArgumentError
            An option is not one of those above.
        """
        for argument, value, known in (
            ("missing_meshes", missing_meshes, ("error", "skip")),
            ("dissipation", dissipation, tuple(DISSIPATION)),
        ):
            choice(argument, value, known)
        if not isinstance(package_dirs, list | tuple) or not all(
            isinstance(folder, str | Path) for folder in package_dirs
        ):
            raise InvalidArgumentError(
                "package_dirs",
                "must be folders",
                value=package_dirs,
                remedy="pass a list of paths",
            )
        fixed_base = flag("fixed_base", fixed_base)
        path = _find(name_or_path)
        urdf = read_urdf(path, package_dirs=tuple(map(Path, package_dirs)), missing_meshes=missing_meshes)
        joints = tuple(joint for joint in urdf.joints if joint.moves)
        if not joints:
            raise RobotError(
                f"{path}: a robot without moving joints has nothing to control; check the joint types"
            )
        srdf = path.with_suffix(".srdf")
        bundled = path.parent == _ASSETS
        return cls(
            name=urdf.name,
            path=path,
            urdf=urdf.text,
            srdf=etree.tostring(parse_xml(srdf), encoding="unicode") if srdf.is_file() else None,
            joints=joints,
            all_joints=urdf.joints,
            links=urdf.links,
            missing_meshes=urdf.missing_meshes,
            dissipation=dissipation,
            fixed_base=fixed_base,
            settings=_read_settings(path.with_suffix(".yaml"), joints) if bundled else None,
        )

    @staticmethod
    def bundled() -> tuple[str, ...]:
        """Names of the robots that ship with batchpid."""
        return tuple(sorted(path.stem for path in _ASSETS.glob("*.urdf")))

    @property
    def dof(self) -> int:
        """Number of degrees of freedom."""
        return len(self.joints)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the degrees of freedom, in SAPIEN's order."""
        return tuple(joint.name for joint in self.joints)

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the positions, "rad" or "m", in the order of :attr:`joint_names`."""
        return tuple(joint.unit for joint in self.joints)

    @property
    def lower(self) -> Float64:
        """Lower position limits (dof,) [rad or m]."""
        return np.array([joint.lower for joint in self.joints])

    @property
    def upper(self) -> Float64:
        """Upper position limits (dof,) [rad or m]."""
        return np.array([joint.upper for joint in self.joints])

    @property
    def effort_limit(self) -> Float64:
        """Effort limits (dof,) [N m or N], infinite where the URDF gives none."""
        return np.array([joint.effort_limit for joint in self.joints])

    @property
    def velocity_limit(self) -> Float64:
        """Velocity limits (dof,) [rad/s or m/s], infinite where the URDF gives none. SAPIEN does not enforce them."""
        return np.array([joint.velocity_limit for joint in self.joints])

    @property
    def continuous(self) -> NDArray[np.bool_]:
        """Which joints wrap at a full turn (dof,)."""
        return np.array([joint.continuous for joint in self.joints])

    @property
    def damping(self) -> Float64:
        """Viscous damping of the joints (dof,) [N m s/rad or N s/m]."""
        return np.array([joint.damping for joint in self.joints])

    @property
    def start(self) -> Float64:
        """Start pose (dof,): the bundled settings', else zero moved inside the joint limits."""
        if self.settings is not None:
            return self.settings.start.copy()
        return np.clip(np.zeros(self.dof), self.lower, self.upper)

    def params(self, **options: Any) -> bp.PIDParams:
        """PID parameters for this robot: :func:`batchpid.make_params` with the robot's figures filled in.

        Effort limits and continuous joints come from the URDF and, for a bundled robot, kp, ki and kd from its
        settings; anti-windup is "conditional". ``options`` override these and add others.

        Raises
        ------
        InvalidArgumentError
            The robot carries no gains and ``options`` has no ``kp``.
        """
        known: dict[str, Any] = {
            "joint_names": self.joint_names,
            "effort_limit": self.effort_limit,
            "anti_windup": "conditional",
        }
        if self.continuous.any():
            known["continuous"] = self.continuous
        if "effort_min" in options or "effort_max" in options:
            del known["effort_limit"]
        if self.settings is not None:
            known |= {gain: getattr(self.settings, gain) for gain in ("kp", "ki", "kd")}
        elif "kp" not in options:
            raise InvalidArgumentError(
                "kp",
                f"robot {self.name!r} carries no gains",
                remedy="pass kp=, ki=, kd= (scalar or per joint)",
            )
        return bp.make_params(joints=self.dof, **(known | options))

    def check(
        self,
        *,
        params: bp.PIDParams | None = None,
        qpos: ArrayLike | None = None,
        setpoint: ArrayLike | None = None,
        timestep: float = 1 / 2000,
        control: str = "pid",
    ) -> list[Finding]:
        """Preflight: what is odd about this robot, and about running it this way.

        Parameters
        ----------
        params
            The PID's, to check them too; default those of :meth:`params` where the robot carries gains.
        qpos, setpoint
            Start pose (default :attr:`start`) and setpoint (default: none) to check, (dof,) [rad or m].
        timestep
            Of control and simulation [s].
        control
            As :class:`sim.Runner` takes it.

        Returns
        -------
        Findings, most severe first; empty where nothing is odd.
        """
        if params is None and self.settings is not None and control == "pid":
            params = self.params()
        return check(self, params=params, qpos=qpos, setpoint=setpoint, timestep=timestep, control=control)

    def sample(self, count: int, seed: int = 0) -> Float64:
        """``count`` seeded poses (count, dof), uniform within the limits and within half a turn of the start pose."""
        low, high = np.maximum(self.lower, self.start - np.pi), np.minimum(self.upper, self.start + np.pi)
        return np.random.default_rng(seed).uniform(low, high, (count, self.dof))

    def mass_matrix(self, qpos: ArrayLike) -> Float64:
        """Joint-space mass matrices (n, dof, dof) [kg m^2 or kg] at ``qpos`` (n, dof) or (dof,), on a fixed base."""
        return self.probe().mass_matrix(np.atleast_2d(np.asarray(qpos, np.float64)))

    def probe(self, ground: bool = True) -> Probe:
        """Return what answers questions about poses: mass matrix, inverse dynamics, contact. Loads SAPIEN."""
        from .building import SceneSpec
        from .probe import probe

        return probe(SceneSpec(self.urdf, self.srdf, self.joints, 1e-3, PHYSICS["fast"], ground=ground))

    def tuned(self) -> dict[str, Any]:
        """Options of :class:`sim.Runner` with which a bundled robot settles: tuned params, and what they need.

        ``Runner(robot, 64, **robot.tuned())``. See docs/choosing-gains.md.

        Raises
        ------
        InvalidArgumentError
            The robot is not bundled.
        """
        path = self.path.with_name(f"{self.path.stem}.tuned.yaml")
        if self.settings is None or not path.is_file():
            raise InvalidArgumentError(
                "robot",
                f"{self.name!r} carries no tuned gains",
                remedy="use batchpid.design_gains(robot), or make some with: batchpid tune",
            )
        params, _ = bp.load_params(path, self.joint_names)
        return {
            "params": params,
            "measurement_rate": bool(bp.load_about(path).get("measurement_rate", False)),
        }

    def limit_violations(self, qpos: ArrayLike, tolerance: float = 1e-6) -> list[tuple[int, int, float]]:
        """Entries of ``qpos`` (dof,) or (envs, dof) outside the joint limits, as (env, joint, value)."""
        rows = np.atleast_2d(np.asarray(qpos, np.float64))
        outside = (rows < self.lower - tolerance) | (rows > self.upper + tolerance)
        return [(int(env), int(joint), float(rows[env, joint])) for env, joint in np.argwhere(outside)]


def _find(name_or_path: str | Path) -> Path:
    if not isinstance(name_or_path, str | Path):
        raise InvalidArgumentError(
            "name_or_path",
            "must be a string or Path",
            value=name_or_path,
            remedy="pass a robot's name or a URDF path",
        )
    bundled = _ASSETS / f"{name_or_path}.urdf"
    if str(name_or_path) in Robot.bundled():
        return bundled
    path = Path(name_or_path).expanduser()
    if "\0" not in str(path) and path.is_file():
        return path.absolute()
    raise RobotNotFoundError(
        f"no robot {str(name_or_path)!r}: neither bundled ({', '.join(Robot.bundled())}) nor a file; "
        "check the spelling, or pass the path of a URDF"
    )


def _read_settings(path: Path, joints: tuple[Joint, ...]) -> Settings:
    data = yaml.safe_load(path.read_text())

    def column(key: str) -> Float64:
        return np.array([float(data["joints"][joint.name][key]) for joint in joints])

    return Settings(
        start=column("start"),
        target=column("target"),
        kp=column("kp"),
        ki=column("ki"),
        kd=column("kd"),
        drive_stiffness=float(data["drive"]["stiffness"]),
        drive_damping=float(data["drive"]["damping"]),
        rate_hz=float(data["rate_hz"]),
        notes=tuple(data.get("notes", ())),
    )
