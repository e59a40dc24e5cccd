"""Arguments of a Runner's commands: checked before anything changes, and returned as copies."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

import batchpid as bp
from batchpid.checks.validate import AxisKind, array, env_mask, integer, read_array, within
from batchpid.errors import InvalidArgumentError
from batchpid.motors.coupling import Coupling
from batchpid.sim.command import POSE_UNITS, TWIST_UNITS
from batchpid.sim.engine.robot_model import robot_model
from batchpid.sim.loop.arrays import Command
from batchpid.sim.loop.faults import FARTHEST, ORIGIN
from batchpid.sim.options import RunnerOptions
from batchpid.sim.robot.limits import SetpointCheck

_Axis = tuple[AxisKind, tuple[str, ...]]


class Arguments:
    """Checks of the arguments of a runner's commands."""

    def __init__(self, options: RunnerOptions) -> None:
        robot, own = options.robot, options.own_command
        self._options, self._robot = options, robot
        self._finite = options.on_invalid_input == "raise"
        entries: _Axis = ("joint" if own is None else "entry", options.command.names)
        self._axes: tuple[_Axis, ...] = (entries, entries, entries, ("joint", robot.joint_names))
        """Last axis of each array of a command: its kind, and the names of its columns."""
        self._coupling = robot.coupling if options.sets_positions else Coupling.of(robot.dof)
        self._limits = SetpointCheck(robot)
        self._checks_setpoints = options.sets_positions and options.guard is None

    def substeps(self, substeps: int | None) -> int:
        """Return the sim steps of a tick, by default the runner's."""
        return self._options.substeps if substeps is None else integer("substeps", substeps, 1, 1_000_000)

    def tick(self, params: bp.PIDParams, *command: ArrayLike | None) -> Command:
        """Return the command (1, envs, ...) of one tick, from its arrays in the order of :class:`Command`."""
        given = dict(zip(Command._fields, command, strict=True))
        if command[2] is not None:
            self._check_acceleration(params, given)
        read = self._read(given)
        if self._checks_setpoints:
            self._limits.check("setpoint", read.setpoint, stacklevel=5)
        return read

    def ticks(self, params: bp.PIDParams, setpoints: ArrayLike, *others: ArrayLike | None) -> Command:
        """Return the command (ticks, envs, ...) of a rollout, from its arrays in the order of :class:`Command`."""
        shape, num_envs, size = read_array("setpoints", setpoints).shape, self._options.num_envs, len(self._axes[0][1])
        if len(shape) not in (2, 3) or shape[0] == 0:
            raise InvalidArgumentError(
                "setpoints",
                f"must have shape (ticks, {num_envs}, {size}) or (ticks, {size})",
                value=shape,
                remedy=f"repeat a constant setpoint with np.broadcast_to(setpoint, (ticks, {size}))",
            )

        def of_ticks(name: str, value: ArrayLike | None) -> NDArray[Any] | None:
            rows = None if value is None else read_array(name, value)
            return rows if rows is None or rows.ndim != 2 else rows[:, None]

        given = {f"{name}s": rows for name, rows in zip(Command._fields, (setpoints, *others), strict=True)}
        if others[1] is not None:
            self._check_acceleration(params, given)
        command = self._read({name: of_ticks(name, value) for name, value in given.items()}, shape[0])
        if self._checks_setpoints:
            self._limits.check("setpoint", command.setpoint, stacklevel=5)
        return command

    def start(
        self, qpos: ArrayLike | None, qvel: ArrayLike | None, mask: ArrayLike | None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
        """Return positions and velocities (envs, dof) to reset to, and the envs to reset (envs,)."""
        position = self._pose("qpos", self._robot.start if qpos is None else qpos)
        velocity = self._pose("qvel", 0.0 if qvel is None else qvel)
        num_envs = self._options.num_envs
        chosen = np.ones(num_envs, bool) if mask is None else env_mask("mask", mask, num_envs)
        self._limits.check("qpos", self._robot.coupled(position), chosen, stacklevel=5)
        return position, velocity, chosen

    def base(
        self, pose: ArrayLike | None, twist: ArrayLike | None, qpos: NDArray[np.float64], mask: NDArray[np.bool_]
    ) -> NDArray[np.float64] | None:
        """Return poses and twists (envs, 13) of floating bases to reset to, at joint positions ``qpos``.

        By default a base is at rest, upright, and so high that the robot's lowest point is on the ground.
        """
        robot, num_envs = self._robot, self._options.num_envs
        if robot.fixed_base:
            for name, value in (("base_pose", pose), ("base_twist", twist)):
                if value is not None:
                    remedy = "leave it out, or load the robot with fixed_base=False"
                    raise InvalidArgumentError(name, "is for a floating base, and this one is fixed", remedy=remedy)
            return None
        rows = np.tile(ORIGIN, (num_envs, 1))
        if twist is not None:
            rows[:, 7:] = array("base_twist", twist, (num_envs, 6), tuple(TWIST_UNITS), kind="entry")
        if pose is not None:
            rows[:, :7] = array("base_pose", pose, (num_envs, 7), tuple(POSE_UNITS), kind="entry")
            length = np.linalg.norm(rows[:, 3:7], axis=1, keepdims=True)
            if not length.all():
                problem = f"env {int(np.flatnonzero(length == 0)[0])} has a quaternion of length 0"
                raise InvalidArgumentError("base_pose", problem, remedy="give (w, x, y, z), (1, 0, 0, 0) upright")
            rows[:, 3:7] /= length
        elif self._options.ground:
            heights: dict[bytes, float] = {}
            for env in np.flatnonzero(mask).tolist():
                key = qpos[env].tobytes()
                if key not in heights:
                    heights[key] = robot_model(robot).height(np.nan_to_num(qpos[env]), base_too=True)
                rows[env, 2] = -heights[key] if np.isfinite(heights[key]) else 0.0
        return rows

    def _check_acceleration(self, params: bp.PIDParams, given: Mapping[str, Any]) -> None:
        """Raise InvalidArgumentError for an acceleration that the law does not take."""
        _, (rate, given_rate), (name, _), _ = given.items()
        if self._options.control != "pid" or params.gain_units is None:
            remedy = "give M(q) times it as feedforward, or use gains in accelerations, such as robot.designed()"
            raise InvalidArgumentError(name, "is for gains in accelerations, and these are efforts", remedy=remedy)
        if given_rate is None:
            raise InvalidArgumentError(name, f"has no {rate} beside it", remedy=f"give {rate}, too")

    def _pose(self, name: str, value: ArrayLike) -> NDArray[np.float64]:
        shape = (self._options.num_envs, self._robot.dof)
        rows = array(name, value, shape, self._robot.joint_names, finite=self._finite).copy()
        if self._finite:
            return within(name, rows, FARTHEST, self._robot.joint_names)
        return np.where(np.abs(rows) > FARTHEST, np.nan, rows)

    def _read(self, given: Mapping[str, Any], ticks: int | None = None) -> Command:
        """Return the command (ticks, envs, ...) of the arguments ``given``, of one tick if ``ticks`` is None.

        Positions of followers become those that their leaders mean for them; efforts act on leaders in the loop.
        """
        table = (self._options.num_envs,) if ticks is None else (ticks, self._options.num_envs)
        rows = list[Any]()
        for (name, value), (kind, names) in zip(given.items(), self._axes, strict=True):
            if value is None and rows:  # the setpoint, which is first, must be given
                rows.append(None)
                continue
            own = array(name, value, (*table, len(names)), names, finite=self._finite, kind=kind).copy()
            rows.append(own[None] if ticks is None else own)
        rows[0] = self._coupling.positions(rows[0])
        for index in (1, 2):
            if rows[index] is not None:
                rows[index] = self._coupling.rates(rows[index])
        return Command._make(rows)
