r"""Motors from commanded efforts u and measured efforts m, without a rigid-body model; robots may be in contact.

The effort e is the command after delay and lag. A sensor at the motor measures the effort of the motor. A sensor behind
the gear measures it minus the effort for inertia, damping and friction of the motor::

    m = s e + b,     m = s e + b - A q'' - B q' - F sgn(q')     (sensor at the link)
    e_k = e_{k-1} + (1 - exp(-dt / T)) (u(t_k - d) - e_{k-1})

The delay d of all joints and the lags T are searched on a grid; the other unknowns are then linear. Least squares
refine all of them. Lags are accepted if they lower the error on the held-out rows.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

import batchpid as bp
from batchpid.arrays.array_types import Float64
from batchpid.errors import InvalidArgumentError
from batchpid.sim.identification.inputs import Inputs, read_inputs
from batchpid.sim.identification.log import Log, interpolated
from batchpid.sim.identification.regression import CUTOFF, DELAYS, EDGE, lowpass, smooth
from batchpid.sim.identification.result import actuators_at
from batchpid.sim.identification.statistics import INTERVAL, LEAST_DEVIATION, PARTS, jackknife_variance
from batchpid.sim.identification.unknowns import KINDS, Motors, Unknowns
from batchpid.sim.identification.windows import share_fitted
from batchpid.sim.robot.robot import Robot

LAGS = np.r_[0.0, np.geomspace(5e-4, 0.1, 12)]
"""Lags of the grid [s]."""
GAIN = 0.99
"""Largest ratio of the errors with and without lags for which lags are accepted."""
OF_MOTOR, OF_LINK = ("strength", "bias"), ("strength", "bias", "armature", "damping", "friction")


class EffortRatios(NamedTuple):
    """Motors identified from commanded and measured efforts."""

    joints: tuple[int, ...]
    names: tuple[tuple[str, int | None], ...]
    """Kind and joint of each value."""
    estimate: Float64
    """Values (values,)."""
    deviation: Float64
    """Standard deviations (values,), by the jackknife over parts of the logs."""
    error: Float64
    """Relative error (joints,): root mean square error on the held-out rows, over the root mean square effort."""

    def values(self, kinds: Iterable[str]) -> Motors:
        """Return the identified values among ``kinds``, (1, joints) or (1, 1)."""
        own = {kind: [at for at, name in enumerate(self.names) if name[0] == kind] for kind in kinds}
        return {kind: self.estimate[None, places] for kind, places in own.items() if places}

    def document(self, robot: Robot) -> dict[str, dict[str, list[float]]]:
        """Return estimate, lower and upper end of the 95 % interval by joint and kind, the delay as "all joints"."""
        found: dict[str, dict[str, list[float]]] = {}
        for (kind, joint), value, half in zip(self.names, self.estimate, INTERVAL * self.deviation, strict=True):
            place = found.setdefault("all joints" if joint is None else robot.joint_names[self.joints[joint]], {})
            place[kind] = [float(value), float(value - half), float(value + half)]
        return found

    def save(self, path: str | os.PathLike[str], robot: Robot) -> None:
        """Write the actuators of ``robot``, with intervals, to a .yaml or .json file; other joints are ideal."""
        nothing = np.zeros(len(self.names))
        motors = actuators_at(
            robot, self.joints, Unknowns(len(self.joints), self.names, nothing, nothing), self.estimate
        )
        about = {"intervals": self.document(robot), "effort_error": self.error.tolist()}
        bp.save_actuators(path, motors, robot.joint_names, about)


def measured_motors(
    robot: Robot, logs: Iterable[str | os.PathLike[str] | Log], *, timestep: float | None = None, hold: bool = False
) -> EffortRatios:
    """Identify motors from commanded and measured efforts; the robot may be in contact.

    The arguments are as in :func:`batchpid.sim.identification.identify`. Raises InvalidArgumentError if the logs
    lack efforts of both kinds, and the errors of :func:`batchpid.sim.identification.identify`.
    """
    return effort_ratios(read_inputs(robot, logs, None, "none", timestep, 1, hold))


def effort_ratios(inputs: Inputs) -> EffortRatios:
    """Return the motors identified from the commanded and measured efforts of logs."""
    if any(log.measured is None for log in inputs.logs):
        remedy = "add columns effort:JOINT and measured_effort:JOINT"
        raise InvalidArgumentError("logs", "lack efforts that are both commanded and measured", remedy=remedy)
    tables = _Tables(inputs)
    without, with_lags = (tables.solve(lags) for lags in (LAGS[:1], LAGS))
    return with_lags if with_lags.error.mean() < GAIN * without.error.mean() else without


class _Tables:
    """Commands on the grid of the sim steps, and measured efforts and motions at the rows of all logs."""

    def __init__(self, inputs: Inputs) -> None:
        self._dt, self._joints = inputs.drive.timestep, inputs.joints
        self._links = inputs.logs[0].sensor == "link"
        self._commands, self._index, rows = list[Float64](), [], []
        for log in inputs.logs:
            motion = smooth(log, self._dt)
            grid = log.time[0] + self._dt * np.arange(len(motion.qpos))
            time = log.time[(log.time > log.time[0] + EDGE) & (log.time < log.time[-1] - EDGE)]
            self._commands.append(self._filtered(log.commands_at(grid)))
            # A row holds the effort of the step that ends there.
            self._index.append(np.ceil((time - log.time[0]) / self._dt - 1e-6).astype(int) - 1)
            assert log.measured is not None
            measured = interpolated(grid, log.time, log.measured)
            sign = self._filtered(np.clip(motion.qvel / (0.01 * np.abs(motion.qvel).max(0) + 1e-9), -1, 1))
            own = [-motion.qacc, -motion.qvel, -sign] if self._links else []
            fitted = time <= log.time[0] + share_fitted(log) * log.seconds
            tables = [each[self._index[-1] + 1] for each in (self._filtered(measured), *own)]
            rows.append([fitted, *tables])
        self._fitted, self._measured, *self._motion = (np.concatenate(each) for each in zip(*rows, strict=True))

    def _filtered(self, table: Float64) -> Float64:
        """Return ``table`` filtered as the motion is, if the sensor is at the link; otherwise unchanged."""
        return lowpass(table, CUTOFF, self._dt) if self._links else table

    def _columns(self, delay: float, lag: float, joint: int) -> Float64:
        """Return the columns of the linear unknowns of a joint (rows, unknowns)."""
        from scipy.signal import lfilter

        parts = []
        for command, index in zip(self._commands, self._index, strict=True):
            step = np.arange(len(command))
            late = np.interp(step - delay / self._dt, step, command[:, joint])
            if lag > 0:
                keep = np.exp(-self._dt / lag)
                late = lfilter([1 - keep], [1, -keep], late, zi=[keep * late[0]])[0]
            parts.append(late[index])
        effort = np.concatenate(parts)
        return np.stack([effort, np.ones_like(effort), *(each[:, joint] for each in self._motion)], axis=1)

    def _linear(self, delay: float, lag: float, joint: int) -> tuple[float, Float64]:
        """Return the logarithm of the fitted rows' mean square, and the linear unknowns of a joint."""
        columns, wanted = self._columns(delay, lag, joint)[self._fitted], self._measured[self._fitted, joint]
        found = np.linalg.lstsq(columns, wanted, rcond=None)[0]
        return float(np.log(((wanted - columns @ found) ** 2).mean() + 1e-30)), found

    def solve(self, lags: Float64) -> EffortRatios:
        """Return the solution for a grid with ``lags``."""
        from scipy.optimize import least_squares

        joints, kinds = range(len(self._joints)), (*(OF_LINK if self._links else OF_MOTOR), "lag")
        grid = np.array([[[self._linear(d, lag, j)[0] for lag in lags] for j in joints] for d in DELAYS[::2]])
        first = int(grid.min(2).sum(1).argmin())
        delay, at = DELAYS[::2][first], lags[grid[first].argmin(1)]
        start = [np.r_[self._linear(delay, at[j], j)[1], at[j]] for j in joints]
        names = [("delay", None), *((kind, joint) for joint in joints for kind in kinds)]
        free = np.array([len(lags) > 1 or kind != "lag" for kind, _ in names])
        x = np.r_[delay, np.concatenate(start)]
        sizes = np.exp(0.5 * grid[first].min(1))

        def errors(unknown: Float64) -> Float64:
            values = x.copy()
            values[free] = unknown
            table = values[1:].reshape(len(joints), -1)
            modelled = [self._columns(values[0], own[-1], j) @ own[:-1] for j, own in zip(joints, table, strict=True)]
            return (np.stack(modelled, axis=1) - self._measured) / sizes

        times = np.array([kind in ("delay", "lag") for kind, _ in names])[free]
        low, high = np.where(times, 0.0, -np.inf), np.where(times, KINDS["delay"].high, np.inf)
        scale = np.where(times, 1e-3, np.maximum(np.abs(x[free]), 1e-3))

        def residuals(unknown: Float64) -> Float64:
            return errors(unknown)[self._fitted].ravel()

        def jacobian(unknown: Float64) -> Float64:
            steps, begin = 0.1 * scale, residuals(unknown)
            return np.stack([(residuals(unknown + h) - begin) / h.sum() for h in np.diag(steps)], axis=1)

        begin = np.clip(x[free], low, high)
        found = least_squares(residuals, begin, jacobian, (low, high), x_scale=scale, max_nfev=20)
        error = errors(found.x)
        parts = []
        for rows in np.array_split(np.arange(len(found.fun)), PARTS):
            slopes = found.jac[rows]
            parts.append((slopes.T @ slopes, -slopes.T @ found.fun[rows]))
        deviation = np.sqrt(jackknife_variance(parts, np.full(free.sum(), 1e-9)))
        share = np.sqrt((error[~self._fitted] ** 2).mean(0) / (self._measured[~self._fitted] ** 2).mean(0)) * sizes
        chosen = tuple(name for name, own in zip(names, free, strict=True) if own)
        deviation = np.hypot(deviation, LEAST_DEVIATION * np.abs(found.x))
        return EffortRatios(self._joints, chosen, found.x, deviation, share)
