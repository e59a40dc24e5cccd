r"""Motors from efforts that are both commanded, u, and measured, m: without a rigid-body model, also in contact.

Behind the motor m is what the motor delivers; behind the gear it lacks what the motor itself takes::

    m = s e + b,     m = s e + b - A q'' - B q' - F sgn(q')     (sensor at the link)
    e_k = e_{k-1} + (1 - exp(-dt / T)) (u(t_k - d) - e_{k-1})

The delay d, common to all joints, and the lags T are found on a grid and refined by Gauss-Newton steps; the others are
linear. A lag is accepted where it lowers the error on the last quarter of the logs.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

import batchpid as bp
from batchpid.arrays.array_types import Float64
from batchpid.errors import InvalidArgumentError
from batchpid.sim.identification.inputs import Inputs, read_inputs
from batchpid.sim.identification.log import Log
from batchpid.sim.identification.regression import CUTOFF, DELAYS, EDGE, smooth
from batchpid.sim.identification.statistics import INTERVAL, LEAST_DEVIATION, PARTS, variance_between
from batchpid.sim.identification.unknowns import KINDS, Motors, kind_of
from batchpid.sim.identification.windows import share_fitted
from batchpid.sim.robot.robot import Robot

LAGS = np.r_[0.0, np.geomspace(5e-4, 0.1, 12)]
"""Lags that are tried [s]."""
STEPS, STEP = 8, 1e-4
"""Gauss-Newton steps, and change of a time for a finite difference [s]."""
GAIN = 0.99
"""Largest error with a lag that is accepted, over the error without."""
OF_MOTOR, OF_LINK = ("strength", "bias"), ("strength", "bias", "armature", "damping", "friction")


class EffortRatios(NamedTuple):
    """Values that measured efforts show."""

    robot: Robot
    joints: tuple[int, ...]
    names: tuple[tuple[str, int | None], ...]
    """Kind and joint of each value."""
    estimate: Float64
    deviation: Float64
    """Standard deviations (values,)."""
    error: Float64
    """Root mean squares of the error on the last quarter of the logs, over those of the efforts (joints,)."""

    def values(self, *kinds: str) -> Motors:
        """Return the values of ``kinds``, (1, joints) or (1, 1), of those that were found."""
        return {
            kind: np.array([[self.estimate[at] for at, name in enumerate(self.names) if name[0] == kind]])
            for kind in kinds
            if kind in dict(self.names)
        }

    def row(self, index: int) -> tuple[float, float, float]:
        """Return estimate, lower and upper end of the 95 % interval of a value."""
        value, half = float(self.estimate[index]), INTERVAL * float(self.deviation[index])
        kind = kind_of(self.names[index][0])
        return value, max(value - half, kind.low), min(value + half, kind.high)

    def actuators(self) -> bp.Actuators:
        """Return the actuators of the robot; other joints are ideal."""
        options = dict[str, Any]()
        for kind, values in self.values(*dict(self.names)).items():
            field = str(kind_of(kind).field)
            options[field] = np.full(self.robot.dof, kind_of(kind).neutral)
            options[field][list(self.joints) if kind_of(kind).per_joint else slice(None)] = values[0]
        return bp.make_actuators(self.robot.dof, **options, joint_names=self.robot.joint_names)

    def document(self) -> dict[str, Any]:
        """Return the values with their 95 % intervals, by joint and kind."""
        joints: dict[str, Any] = {self.robot.joint_names[joint]: {} for joint in self.joints}
        common = dict[str, Any]()
        for index, (kind, joint) in enumerate(self.names):
            place = common if joint is None else joints[self.robot.joint_names[self.joints[joint]]]
            place[kind] = list(self.row(index))
        return {"joints": joints, **common, "effort_error": self.error.tolist()}

    def save(self, path: str | os.PathLike[str], logs: list[str]) -> None:
        """Write the actuators, with their intervals and the names of the logs, to a .yaml or .json file."""
        about = {"identified_from": logs, "intervals": self.document(), "method": "measured over commanded efforts"}
        bp.save_actuators(path, self.actuators(), self.robot.joint_names, about)


def measured_motors(
    robot: Robot,
    logs: Iterable[str | os.PathLike[str] | Log],
    *,
    timestep: float | None = None,
    hold: bool = False,
) -> EffortRatios:
    """Return the motors that efforts show which are both commanded and measured; the robot may be in contact.

    The arguments are those of :func:`batchpid.sim.identification.identify`. Raises InvalidArgumentError if the logs
    lack efforts of both kinds, and the errors of :func:`batchpid.sim.identification.identify`.
    """
    return effort_ratios(read_inputs(robot, logs, None, "none", timestep, 1, hold))


def effort_ratios(inputs: Inputs) -> EffortRatios:
    """Return the motors that the efforts of logs show, which are commanded and measured."""
    if any(log.measured is None for log in inputs.logs):
        remedy = "add columns effort:JOINT and measured_effort:JOINT"
        raise InvalidArgumentError("logs", "lack efforts that are both commanded and measured", remedy=remedy)
    tables = _Tables(inputs)
    without, with_lag = tables.solve(lag=False), tables.solve(lag=True)
    best = with_lag if with_lag.error.mean() < GAIN * without.error.mean() else without
    return EffortRatios(inputs.robot, inputs.joints, *best)


class _Solution(NamedTuple):
    names: tuple[tuple[str, int | None], ...]
    estimate: Float64
    deviation: Float64
    error: Float64


class _Tables:
    """Commands on the grid of the sim steps, and measured efforts and motions at the rows of all logs."""

    def __init__(self, inputs: Inputs) -> None:
        self._dt, self._joints = inputs.drive.timestep, len(inputs.joints)
        self._links = inputs.logs[0].sensor == "link"
        self._commands, self._index, rows = list[Float64](), [], []
        for log in inputs.logs:
            motion = smooth(log, self._dt)
            grid = log.time[0] + self._dt * np.arange(len(motion.qpos))
            kept = (log.time > log.time[0] + EDGE) & (log.time < log.time[-1] - EDGE)
            step = np.ceil((log.time[kept] - log.time[0]) / self._dt - 1e-6).astype(int) - 1
            self._commands.append(self._filtered(log.commands_at(grid)))
            self._index.append(np.clip(step, 0, len(grid) - 1))
            assert log.measured is not None
            measured = self._filtered(np.stack([np.interp(grid, log.time, m) for m in log.measured.T], 1))
            at = self._index[-1] + 1 if self._links else None
            table = log.measured[kept] if at is None else measured[np.minimum(at, len(grid) - 1)]
            speed = 0.01 * np.abs(motion.qvel).max(0) + 1e-9
            sign = self._filtered(np.clip(motion.qvel / speed, -1, 1))
            own = (motion.qacc, motion.qvel, sign) if self._links else ()
            held = log.time[kept] > log.time[0] + share_fitted(log) * log.seconds
            rows.append((table, held[:, None], *(-each[self._index[-1]] for each in own)))
        self._measured, self._held_out, *self._motion = (np.concatenate(each) for each in zip(*rows, strict=True))

    def _filtered(self, table: Float64) -> Float64:
        from scipy.signal import butter, sosfiltfilt

        return sosfiltfilt(butter(4, CUTOFF, fs=1 / self._dt, output="sos"), table, axis=0) if self._links else table

    def _columns(self, delay: float, lag: float, joint: int) -> Float64:
        """Return the columns of the linear unknowns of a joint (rows, unknowns)."""
        from scipy.signal import lfilter

        parts = []
        for command, index in zip(self._commands, self._index, strict=True):
            step = np.arange(len(command))
            late = np.interp(step - delay / self._dt, step, command[:, joint])
            if lag > 0:
                a = 1 - np.exp(-self._dt / lag)
                late = lfilter([a], [1, a - 1], late, zi=[(1 - a) * late[0]])[0]
            parts.append(late[index])
        effort = np.concatenate(parts)
        return np.stack([effort, np.ones_like(effort), *(each[:, joint] for each in self._motion)], axis=1)

    def _residual(self, delay: float, lag: float, joint: int) -> tuple[Float64, Float64, Float64]:
        """Return columns, linear unknowns and residual of a joint."""
        fitted, columns = ~self._held_out[:, 0], self._columns(delay, lag, joint)
        found = np.linalg.lstsq(columns[fitted], self._measured[fitted, joint], rcond=None)[0]
        return columns, found, self._measured[:, joint] - columns @ found

    def solve(self, lag: bool) -> _Solution:
        """Return the solution with lags or without."""
        fitted, joints = ~self._held_out[:, 0], range(self._joints)

        def size(delay: float, lag: float, joint: int) -> float:
            return float(np.log((self._residual(delay, lag, joint)[2][fitted] ** 2).mean() + 1e-30))

        lags = LAGS if lag else LAGS[:1]
        costs = np.array([[[size(d, each, joint) for each in lags] for joint in joints] for d in DELAYS[::2]])
        first = int(costs.min(2).sum(1).argmin())
        times = np.r_[DELAYS[::2][first], lags[costs[first].argmin(1)]]
        kinds = OF_LINK if self._links else OF_MOTOR
        names = [("delay", None), *((kind, joint) for joint in joints for kind in ((*kinds, "lag") if lag else kinds))]
        for _ in range(STEPS):
            jacobian, residual, found = self._linear(times, lag)
            change = np.linalg.lstsq(
                jacobian[:, fitted].reshape(-1, len(names)), residual[:, fitted].ravel(), rcond=None
            )[0]
            shift = np.r_[change[0], change[1 + len(kinds) :: len(kinds) + 1] if lag else np.zeros(self._joints)]
            times = np.clip(times + shift, 0.0, [KINDS["delay"].high, *[LAGS[-1]] * self._joints])
        jacobian, residual, found = self._linear(times, lag)
        estimate = np.r_[times[0], (np.column_stack([found, times[1:]]) if lag else found).ravel()]
        tables = [jacobian[:, rows].reshape(-1, len(names)) for rows in np.array_split(np.flatnonzero(fitted), PARTS)]
        pulls = [residual[:, rows].ravel() for rows in np.array_split(np.flatnonzero(fitted), PARTS)]
        parts = [(table.T @ table, table.T @ pull) for table, pull in zip(tables, pulls, strict=True)]
        deviation = np.hypot(np.sqrt(variance_between(parts, np.full(len(names), 1e-9))), LEAST_DEVIATION * estimate)
        scale = np.sqrt((self._measured[~fitted] ** 2).mean(0))
        error = np.array([self._residual(times[0], times[1 + j], j)[2] for j in joints])[:, ~fitted]
        return _Solution(tuple(names), estimate, deviation, np.sqrt((error**2).mean(1)) / scale)

    def _linear(self, times: Float64, lag: bool) -> tuple[Float64, Float64, Float64]:
        """Return Jacobian (joints, rows, values), residuals (joints, rows), over their sizes, and linear unknowns."""
        fitted, blocks, residuals, linear = ~self._held_out[:, 0], [], [], []
        for joint in range(self._joints):
            columns, found, residual = self._residual(times[0], times[1 + joint], joint)
            size = np.sqrt((residual[fitted] ** 2).mean()) + 1e-12
            later = self._columns(times[0] + STEP, times[1 + joint], joint) @ found
            slower = self._columns(times[0], times[1 + joint] + STEP, joint) @ found
            own = [*columns.T, *([(slower - columns @ found) / STEP] if lag else [])]
            table = np.zeros((len(residual), 1 + len(own) * self._joints))
            table[:, 0] = (later - columns @ found) / STEP
            table[:, 1 + joint * len(own) : 1 + (joint + 1) * len(own)] = np.stack(own, axis=1)
            blocks.append(table / size)
            residuals.append(residual / size)
            linear.append(found)
        return np.array(blocks), np.array(residuals), np.array(linear)
