"""Limits of a robot's setpoints."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

import batchpid as bp
from batchpid.arrays.leaves import frozen
from batchpid.checks.validate import instance
from batchpid.errors import InvalidArgumentError
from batchpid.motors.guard import check_guard
from batchpid.sim.robot.parts import Joint


class GuardedRobot(Protocol):
    """Part of a robot that the guard needs; arrays are (dof,)."""

    @property
    def joints(self) -> tuple[Joint, ...]:
        """Degrees of freedom."""

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the degrees of freedom."""

    @property
    def continuous(self) -> NDArray[np.bool_]:
        """Joints whose positions wrap."""

    @property
    def independent(self) -> NDArray[np.bool_]:
        """Joints that are not followers."""


def setpoint_guard(robot: GuardedRobot, rate: ArrayLike | None, acceleration: ArrayLike | None) -> bp.Guard:
    """Return the limits of setpoints, of the URDF where they are not given; followers have none."""
    own, joints, dof = robot.independent, robot.joints, len(robot.joints)

    def of_leaders(name: str, value: Any) -> Any:
        checked = getattr(bp.make_guard(dof, joint_names=robot.joint_names, **{name: value}), name)
        return None if checked is None else np.where(own, checked, np.inf)

    fastest = [joint.velocity_limit if joint.velocity_limit > 0 else np.inf for joint in joints]
    return bp.make_guard(
        dof,
        lower=np.where(own, [max(joint.lower, joint.soft_lower) for joint in joints], -np.inf),
        upper=np.where(own, [min(joint.upper, joint.soft_upper) for joint in joints], np.inf),
        rate=of_leaders("rate", fastest if rate is None else rate),
        acceleration=of_leaders("acceleration", acceleration),
        continuous=robot.continuous,
        joint_names=robot.joint_names,
    )


def fit_guard(guard: object, robot: GuardedRobot, num_envs: int, control: str, sets_positions: bool) -> bp.Guard | None:
    """Return the guard for a runner's option ``guard``; None means no guard.

    Raises InvalidArgumentError if it does not fit the robot or the control.
    """
    if guard is False or guard is None:
        return None
    if not sets_positions:
        problem, remedy = "limits positions of joints, which this control does not take", "use control 'pid' or 'drive'"
        raise InvalidArgumentError("guard", problem, value=control, remedy=remedy)
    limits = setpoint_guard(robot, None, None) if guard is True else guard
    limits = instance("guard", limits, bp.Guard, "pass True, or robot.guard(...)")
    check_guard(limits, num_envs, robot.joint_names)
    return frozen(limits)
