r"""Simulated motions of candidates along logs: residuals, their likelihood, and their Jacobian.

The residuals of joint j are its measured positions y less the simulated ones, r = y - q(theta). A log is divided into
stretches b; in each the residuals of a joint are white noise of unknown size, so that the negative logarithm of the
likelihood is, over the number of rows and joints::

    mean over rows and joints of log(sigma_bj),     sigma_bj^2 = f_j^2 + (1 - w) s_bj^2 + w (mean over b of s_bj)^2

s_bj is the root mean square of r_j in b, and f twice the noise of the sensor. The mean is there because no model is
exact, and a stretch in which the robot hardly moves would have all the weight. Where the model fails, for example where
a joint slips a little sooner or later in the simulation, the size is large and the stretch has less weight.

Wander is motion by unlogged disturbances. The law reacts to the noise n of the sensors and thereby moves the robot.
Between the rows of a log that noise is unknown, so it is drawn several times; the simulated motion is the mean over the
draws. The deviations of the simulated motions from their mean, over the root of their number less 1, are columns of W.
A further column is the motion due to one standard deviation of an unknown initial velocity. Residuals r of white noise
of size sigma and of wander have the covariance::

    C = sigma^2 (I + W W^T / n^2),     r_white = (I + W W^T / n^2)^(-1/2) r

r_white and its Jacobian replace r and J; half the logarithm of det(I + W W^T / n^2) is added to the negative logarithm
of the likelihood (generalized least squares; L. Ljung, System Identification, 2nd edition, Prentice Hall, 1999, section
7.2).

Column i of the Jacobian is a finite difference: the change of the simulated motion over a small change of unknown i.

Under the PID law a whole log is one simulation. A log of efforts is cut into short windows, because an error of an
uncontrolled arm grows: multiple shooting (H. G. Bock, "Recent advances in parameter identification techniques for
O.D.E.", 1983). The state at the start of a window is unknown, too; its effect, linear for small errors, is projected
out of the residual and the Jacobian of that window.
"""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Float64
from batchpid.sim.identification.log import Log
from batchpid.sim.identification.logged_control import LoggedDrive
from batchpid.sim.identification.regression import Motion
from batchpid.sim.identification.unknowns import Unknowns, take
from batchpid.sim.identification.windows import Subject, Window, cut, project, rows_of, simulate, whole
from batchpid.sim.robot.robot import Robot

CHUNK = 48
"""Most simulations at once."""
STRETCH = 0.5
"""Length of the stretches of a log [s], about."""
NOISES = 2
"""Least size of residuals, over the noise of the sensor."""
SHARED = 0.8
"""w: share of the mean of all stretches in the size of the residuals of each."""
LEAST_NOISE = 1e-6
"""Least noise of a sensor, over the range of the motion."""
WORST = 1e6
"""Largest size of residuals that counts [rad or m]."""
STATE_STEP = 1e-4
"""Change of an initial position [rad or m], and of a velocity per second, for the projection."""


class FitEvaluation(NamedTuple):
    """Residuals of a point, and their Jacobian, of one window."""

    residual: Float64
    """Measured less simulated positions (rows, joints) [rad or m]."""
    white: Float64
    """Residuals of the fitted rows without wander (rows, joints)."""
    jacobian: Float64
    """Change of the simulated positions with the unknowns, also without wander (rows, joints, unknowns)."""
    determinant: Float64
    """Half the logarithm of the determinant of the wander's covariance, per row (stretches, joints)."""
    expected: Float64
    """Standard deviations of the residuals by sensor noise and wander alone (rows, joints) [rad or m]."""


@dataclass
class Problem:
    """Logs to fit, cut into windows."""

    robot: Robot
    joints: tuple[int, ...]
    drive: LoggedDrive
    logs: list[Log]
    motions: list[Motion]
    unknowns: Unknowns
    executor: Executor | None = None
    windows: list[Window] = field(init=False)
    noise: Float64 = field(init=False)
    """Least sizes of residuals (joints,) [rad or m]."""
    stretches: list[list[NDArray[np.intp]]] = field(init=False)
    """Numbers of the fitted rows in each stretch of each window."""

    def __post_init__(self) -> None:
        subjects = [
            Subject.of(
                own or self.robot, self.joints, self.drive if params is None else replace(self.drive, params=params)
            )
            for own, params, *_ in (log.settings for log in self.logs)
        ]
        self._subjects = list(zip(subjects, [log.settings.payload for log in self.logs], strict=True))
        divide = whole if self.drive.params is not None else cut
        self.windows = [
            window
            for number, (log, motion) in enumerate(zip(self.logs, self.motions, strict=True))
            for window in divide(number, log, motion, self.drive.timestep)
        ]
        if not self.draws:
            self.windows = [window._replace(errors=window.errors[:0]) for window in self.windows]  # not to be sent
        self.stretches = [self._divided(window) for window in self.windows]
        self._rows = [len(rows) for stretches in self.stretches for rows in stretches]
        qpos = np.concatenate([log.qpos for log in self.logs])
        measured = np.sqrt(np.mean([motion.sensor.size**2 for motion in self.motions], axis=0))
        self.noise = np.maximum(NOISES * measured, LEAST_NOISE * (np.ptp(qpos, axis=0) + 1e-3))

    def _divided(self, window: Window) -> list[NDArray[np.intp]]:
        rows = np.flatnonzero(window.fitted)
        seconds = np.ptp(self.logs[window.log].time[rows_of(window)][rows]) if len(rows) else 0.0
        return [part for part in np.array_split(rows, max(1, int(seconds / STRETCH))) if len(part)]

    @property
    def count(self) -> int:
        """Number of fitted positions."""
        return sum(self._rows) * len(self.joints)

    @property
    def draws(self) -> int:
        """Number of draws of the law's noise or of the efforts' jitter; 0 if these are known."""
        return min(len(window.errors) for window in self.windows) if self.shoots or self.drive.noisy else 0

    @property
    def shoots(self) -> bool:
        """True if the initial states of the windows are unknown."""
        return self.drive.params is None

    def residuals(self, points: Float64) -> list[Float64]:
        """Return the residuals (points, rows, joints) of each window, without unknown noise.

        In windows with free initial states, the part that these explain is removed, with their effect at the first
        point.
        """
        joints = len(self.joints)
        states = np.eye(2 * joints).reshape(-1, 2, joints) if self.shoots else np.zeros((0, 2, joints))
        found = []
        simulated = self._simulate(points, np.zeros(len(points), int), states)
        for window, (positions, effect) in zip(self.windows, simulated, strict=True):
            residual = window.measured - positions
            none = np.zeros((*residual.shape[1:], 0))
            found.append(np.stack([project(effect, each, none)[0] for each in residual]) if self.shoots else residual)
        return found

    def sizes(self, residuals: list[Float64]) -> Float64:
        """Return the sizes (..., stretches, joints) of the residuals (..., rows, joints) of all windows."""
        with np.errstate(over="ignore", invalid="ignore"):
            squares = [
                (residual[..., rows, :] ** 2).mean(-2)
                for residual, stretches in zip(residuals, self.stretches, strict=True)
                for rows in stretches
            ]
            stretches = np.stack(squares, axis=-2)
            mean = np.average(np.sqrt(stretches), axis=-2, weights=self._rows)[..., None, :]
            return np.sqrt(self.noise**2 + (1 - SHARED) * stretches + SHARED * mean**2)

    def costs(self, sizes: Float64, determinants: Float64 | float = 0.0) -> Float64:
        """Return the negative logarithms of the likelihood (..., joints) for ``sizes`` (..., stretches, joints).

        They are finite where a simulation diverges, too.
        """
        return np.average(np.log(np.fmin(sizes, WORST)) + determinants, axis=-2, weights=self._rows)

    def held_out_errors(self, residuals: list[Float64]) -> Float64:
        """Return the root mean squares (joints,) of the residuals (rows, joints) of all windows on the held-out rows.

        They are inf if a simulation diverges.
        """
        kept = [each[~window.fitted] for each, window in zip(residuals, self.windows, strict=True)]
        with np.errstate(invalid="ignore", over="ignore"):
            errors = np.sqrt((np.concatenate(kept) ** 2).mean(0))
        return np.where(np.isfinite(errors), errors, np.inf)

    def evaluate(self, theta: Float64) -> list[FitEvaluation]:
        """Return residuals and Jacobian of each window at one point (unknowns,)."""
        changes, joints = self.unknowns.changes(theta), len(self.joints)
        inverse, count = np.linalg.inv(changes).T, len(changes) + 1
        points = np.vstack([theta, theta + changes, np.tile(theta, (self.draws, 1))])
        draws = np.r_[np.zeros(count, int), 1 + np.arange(self.draws)]
        states = np.eye(2 * joints).reshape(-1, 2, joints)[0 if self.shoots else joints :]
        found = []
        simulated = self._simulate(points, draws, states)
        for window, stretches, (positions, effect) in zip(self.windows, self.stretches, simulated, strict=True):
            drawn = positions[count:] if self.draws else positions[:1]
            residual = window.measured - drawn.mean(0)
            jacobian = (positions[1:count] - positions[0]).transpose(1, 2, 0) @ inverse
            wander = spread(drawn)
            if self.shoots:
                _, wander = project(effect, residual, wander)
                residual, jacobian = project(effect, residual, jacobian)
            else:
                wander = np.concatenate([wander, effect * window.speed_error], axis=2)
            noise = self.noise / NOISES
            wander /= noise[:, None]
            expected = noise * np.sqrt(1 + (wander**2).sum(2))
            found.append(FitEvaluation(residual, *whiten(wander, stretches, residual, jacobian), expected))
        return found

    def lags(self, seconds: float) -> list[int]:
        """Return how many rows of each log are ``seconds`` long."""
        return [round(seconds / float(np.median(np.diff(log.time)))) for log in self.logs]

    def _simulate(self, points: Float64, draws: NDArray[np.intp], states: Float64) -> list[tuple[Float64, Float64]]:
        """Return for each window the positions (points, rows, joints), and the effect of its initial state.

        ``draws`` (points,) are the numbers of the noise. The effect is taken at the first point, per unit of the
        changes ``states`` (states, 2, joints) of positions and velocities (rows, joints, states).
        """
        count = len(points)
        numbers = np.r_[np.arange(count), np.zeros(len(states), int)]
        states = np.concatenate([np.zeros((count, *states.shape[1:])), STATE_STEP * states])
        motors, draws = self.unknowns.motors(points[numbers]), draws[numbers]
        groups = [list(group) for _, group in groupby(self.windows, self._alike)]
        tasks, places = [], []
        for number, group in enumerate(groups):
            most = max(1, CHUNK // len(group))
            parts = np.array_split(np.arange(len(states)), -(-len(states) // most))
            subject, known = self._subjects[group[0].log]
            loaded = motors | {"payload": motors["payload"] + known}
            tasks += [(subject, group, take(loaded, part), states[part], draws[part]) for part in parts]
            places += [number] * len(parts)
        simulated = self._map(tasks)
        found = []
        for number, group in enumerate(groups):
            pieces = [piece for piece, place in zip(simulated, places, strict=True) if place == number]
            for at in range(len(group)):
                positions = np.concatenate([piece[at] for piece in pieces])
                effect = (positions[count:] - positions[0]) / STATE_STEP
                found.append((positions[:count], effect.transpose(1, 2, 0)))
        return found

    def _map(self, tasks: list[Any]) -> list[list[Float64]]:
        if self.executor is None:
            return [simulate(*task) for task in tasks]
        return list(self.executor.map(simulate, *zip(*tasks, strict=True)))

    def _alike(self, window: Window) -> tuple[Any, ...]:
        """Return what windows have in common that are simulated together."""
        subject, payload = self._subjects[window.log]
        return window.segment.command.shape, window.past, subject.key, payload


def spread(draws: Float64) -> Float64:
    """Return the columns (rows, joints, draws) of W for positions of several draws (draws, rows, joints)."""
    return (draws - draws.mean(0)).transpose(1, 2, 0) / np.sqrt(max(len(draws) - 1, 1))


def whiten(
    wander: Float64, stretches: list[NDArray[np.intp]], residual: Float64, jacobian: Float64
) -> tuple[Float64, Float64, Float64]:
    """Return residuals and Jacobian without wander in the rows of ``stretches``, and half log-determinants.

    Parameters
    ----------
    wander
        W over the noise n (rows, joints, columns).
    residual, jacobian
        (rows, joints) and (rows, joints, unknowns).

    Returns
    -------
    residual, jacobian, determinants
        The last one over the number of rows (stretches, joints).
    """
    determinants = np.zeros((len(stretches), residual.shape[1]))
    if not np.isfinite(wander).all():
        return residual, jacobian, determinants
    white, jacobian = residual.copy(), jacobian.copy()
    for number, rows in enumerate(stretches):
        for joint in range(residual.shape[1]):
            directions, sizes, _ = np.linalg.svd(wander[rows, joint], full_matrices=False)
            shrink = (1 - 1 / np.sqrt(1 + sizes**2))[:, None]
            table = np.column_stack([white[rows, joint], jacobian[rows, joint]])
            table -= directions @ (shrink * (directions.T @ table))
            white[rows, joint], jacobian[rows, joint] = table[:, 0], table[:, 1:]
            determinants[number, joint] = 0.5 * np.log1p(sizes**2).sum() / len(rows)
    return white, jacobian, determinants
