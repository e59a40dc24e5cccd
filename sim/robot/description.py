"""Description of a robot: its joints and links, limits and defaults. Everything here is independent of SAPIEN."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

import batchpid as bp
from batchpid.errors import InvalidArgumentError
from sim.observation import RunInfo
from sim.robot.urdf import Joint, Link

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]


class Dynamics(Protocol):
    """Dynamics and contact of one robot at given poses (n, dof); :class:`sim.engine.dynamics.Dynamics` is one."""

    def mass_matrix(self, qpos: NDArray[Any]) -> Float64:
        """Return the joint-space mass matrices (n, dof, dof) [kg m^2 or kg]."""

    def inverse_dynamics(self, qpos: NDArray[Any], qvel: NDArray[Any], qacc: NDArray[Any]) -> Float64:
        """Return the efforts (n, dof) [N m or N] of a motion, gravity included."""

    def forward_dynamics(self, qpos: NDArray[Any], qvel: NDArray[Any], effort: NDArray[Any]) -> Float64:
        """Return the accelerations (n, dof) [rad/s^2 or m/s^2] under ``effort``, gravity included."""

    def touches(self, qpos: NDArray[Any], clearance: float = 0.0) -> Bool:
        """Return whether links come nearer than ``clearance`` [m] to each other or to the ground (n,)."""


_make_dynamics: list[Callable[[RobotDescription, bool], Dynamics]] = []


def register_dynamics(make: Callable[[RobotDescription, bool], Dynamics]) -> None:
    """Set what :meth:`RobotDescription.dynamics` calls: the engine lies a floor above, so :mod:`sim` connects them."""
    _make_dynamics[:] = [make]


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
class RobotDescription:
    """A robot as its URDF describes it; every array is in the order of ``joint_names``.

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

    def run_info(self, **options: Any) -> RunInfo:
        """Return the info of a run of this robot; ``options`` are further fields of :class:`sim.RunInfo`."""
        return RunInfo(
            robot=self.name,
            joint_names=self.joint_names,
            units=self.units,
            lower=self.lower,
            upper=self.upper,
            effort_limit=self.effort_limit,
            urdf=self.urdf,
            dissipation=self.dissipation,
            **options,
        )

    def sample(self, count: int, seed: int = 0) -> Float64:
        """``count`` seeded poses (count, dof), uniform within the limits and within half a turn of the start pose."""
        low, high = np.maximum(self.lower, self.start - np.pi), np.minimum(self.upper, self.start + np.pi)
        return np.random.default_rng(seed).uniform(low, high, (count, self.dof))

    def mass_matrix(self, qpos: ArrayLike) -> Float64:
        """Joint-space mass matrices (n, dof, dof) [kg m^2 or kg] at ``qpos`` (n, dof) or (dof,), on a fixed base."""
        return self.dynamics().mass_matrix(np.atleast_2d(np.asarray(qpos, np.float64)))

    def dynamics(self, ground: bool = True) -> Dynamics:
        """Return mass matrix, inverse and forward dynamics and contact of this robot on a fixed base. Loads SAPIEN."""
        return _make_dynamics[0](self, ground)

    def limit_violations(self, qpos: ArrayLike, tolerance: float = 1e-6) -> list[tuple[int, int, float]]:
        """Entries of ``qpos`` (dof,) or (envs, dof) outside the joint limits, as (env, joint, value)."""
        rows = np.atleast_2d(np.asarray(qpos, np.float64))
        outside = (rows < self.lower - tolerance) | (rows > self.upper + tolerance)
        return [(int(env), int(joint), float(rows[env, joint])) for env, joint in np.argwhere(outside)]
