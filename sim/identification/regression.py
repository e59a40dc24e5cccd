r"""Start of the fit: smoothed motions, and an inverse-dynamics regression, linear in all unknowns at a given delay.

With the measured motion filtered without phase lag, and the effort u filtered in the same way, each joint obeys::

    s u(t - d) + b + c - h - (M q'')_j = A q''_j + B q'_j + F sgn(q'_j)

which is solved by least squares with A, B, F >= 0, for each delay d of a grid, where the joint moves fast enough not to
stick (J. Swevers, W. Verdonck and J. De Schutter, "Dynamic model identification for industrial robots", IEEE Control
Systems Magazine 27(5), 2007; M. Gautier, "Dynamic identification of robots with power model", ICRA 1997). Under the PID
law u is computed from the filtered positions. A weak prior at strength 1 determines the parameters that the log does
not show.

The noise of a log's columns is found by its frequency: roughly known at the rows, unknown between them.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Float64
from batchpid.motors.actuators import Actuators
from batchpid.sim.identification.log import Log, interpolated
from batchpid.sim.identification.plant import Plant
from batchpid.sim.identification.unknowns import Motors

CUTOFF = 15.0
"""Corner of the filter [Hz]."""
NOISE_CUTOFF = 60.0
"""Frequency [Hz] above which a measured signal counts as noise."""
DRAWS = 16
"""Number of draws of the unknown noise."""
_MOST_NOISE = 4.0
"""Largest noise, over its standard deviation; larger deviations count as motion."""
DELAY_STEP = 5e-4
DELAYS = np.arange(0.0, 0.03, DELAY_STEP)
"""Delays that are tried [s]."""
MOVES, LEAST_ROWS = 0.4, 50
"""Speed, over its root mean square, below which a joint may stick, and the least number of rows above it."""
EDGE = 0.15
"""Time left out at both ends of a log, where the filter begins [s]."""
_EVERY = 0.005
PAYLOADS = (0.0, 0.05, 0.1, 0.2, 0.3, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 5.0)
"""Payloads that are tried [kg]."""
EVIDENCE = 0.3
"""Least decrease of the logarithm of a joint's mean square that counts, on average over the joints."""
_PRIOR = 0.005
"""Weight of the prior at ideal motors, over the effort's size."""
STRENGTHS, GAINS, TAKEN = (0.2, 3.0), (1e-3, 1e3), (1.0, 1.0 + 1e-9)
"""Bounds of the strength; where the gains of the law are not known, so that it is their factor; and where it is 1."""
LEAST_SHARE = 0.05
"""Least share of a joint's effort that moves the links, which the description knows, for a strength to be found. Below
it an error of the model of a twentieth of the effort hides the links, and only ratios to the strength are known."""
NO_PRIOR, WEAK, STRONG = 1e-3, 0.1, 3.0
"""Weights of the prior at strength 1; the strong one is safe where the log hardly shows the strengths."""
FOUND = ("armature", "damping", "friction", "strength", "bias", "delay", "payload")
"""Kinds of unknowns that a regression gives."""


class Noise(NamedTuple):
    """White noise of a table (steps, columns) on the grid of the sim steps."""

    values: Float64
    """Noise at the log's rows, 0 between them (steps, columns)."""
    errors: Float64
    """Draws of the true noise less ``values`` (draws, steps, columns)."""
    size: Float64
    """Standard deviations (columns,), 0 if the rows are too far apart to determine them."""


class Motion(NamedTuple):
    """Smoothed motion of a log on the grid of the sim steps, from its first row on; arrays (steps, joints)."""

    qpos: Float64
    qvel: Float64
    qacc: Float64
    command: Float64
    sensor: Noise
    """Noise of the measured positions."""
    jitter: Noise | None
    """Noise of logged efforts that change between the rows; None where the commands are known."""
    feedforward: Float64 | None = None
    """Efforts that are added to the efforts of the law."""


def smooth(log: Log, timestep: float) -> Motion:
    """Return the motion of ``log`` on the grid, filtered without phase lag."""
    time = log.time[0] + timestep * np.arange(int(log.seconds / timestep) + 1)
    raw = interpolated(time, log.time, log.qpos)
    period = float(np.median(np.diff(log.time)))
    qpos = lowpass(raw, min(CUTOFF, 0.2 / period), timestep, min(len(raw) - 1, round(0.5 / timestep)))
    qvel = np.gradient(qpos, timestep, axis=0)
    command, jitter = log.commands_at(time), None
    if log.kind == "effort" and not log.held:
        efforts, jitter = split(log.command_time, log.command, time, given=True)
        command = efforts + jitter.values if jitter.size.any() else command
    sensor = split(log.time, log.qpos, time)[1]
    forward = None if log.feedforward is None else log.commands_at(time, log.feedforward)
    return Motion(qpos, qvel, np.gradient(qvel, timestep, axis=0), command, sensor, jitter, forward)


def split(time: Float64, table: Float64, grid: Float64, given: bool = False) -> tuple[Float64, Noise]:
    """Return the columns of a table without noise, filtered without phase lag, and their noise.

    Parameters
    ----------
    time
        Times of the rows (rows,) [s].
    table
        (rows, columns).
    grid
        Times at which both are returned (steps,) [s], equidistant.
    given
        True if the errors are errors of the sum of both, which is exact at the rows; False if they are errors of the
        noise, whose part below the cutoff counts as motion.
    """
    from scipy.interpolate import make_interp_spline

    timestep, period, columns = grid[1] - grid[0], float(np.median(np.diff(time))), table.shape[1]
    step = np.clip(np.rint((time - grid[0]) / timestep).astype(int), 0, len(grid) - 1)
    values = np.zeros((len(grid), columns))
    if (share := 1 - 2 * NOISE_CUTOFF * period) < 0.5:
        return interpolated(grid, time, table), Noise(values, np.zeros((0, *values.shape)), np.zeros(columns))
    pad = min(len(grid) - 1, 1000)
    slow = lowpass(make_interp_spline(time, table)(grid), NOISE_CUTOFF, timestep, pad)
    found = table - slow[step]
    size = 1.4826 * np.median(np.abs(found), axis=0) / np.sqrt(share)  # jerks of the joint do not affect the median
    values[step] = np.clip(found, -_MOST_NOISE * size, _MOST_NOISE * size)
    jerks = interpolated(grid, time, found - values[step])
    draws = size * np.random.default_rng(0).standard_normal((DRAWS, *values.shape))
    rows, at_rows = np.unique(step), np.zeros(len(grid), bool)
    at_rows[rows] = True
    of_rows = (make_interp_spline(grid[rows], draw[rows])(grid) for draw in draws)
    taken = np.stack([lowpass(each, NOISE_CUTOFF, timestep, pad) for each in of_rows])
    known = at_rows[:, None]
    errors = np.where(known, 0.0, draws - taken) if given else np.where(known, taken, draws)
    return slow + jerks, Noise(values, errors if errors.any() else errors[:0], size)


def lowpass(table: Float64, cutoff: float, timestep: float, pad: int | None = None) -> Float64:
    """Return the columns of a table (steps, columns) without frequencies above ``cutoff`` [Hz], without phase lag.

    For the filter, the table is extended by ``pad`` steps at both ends; default as in ``scipy.signal.sosfiltfilt``.
    """
    from scipy.signal import butter, sosfiltfilt

    return sosfiltfilt(butter(4, cutoff, fs=1 / timestep, output="sos"), table, axis=0, padlen=pad)


class FirstGuess(NamedTuple):
    """Result of the regression."""

    motors: Motors
    cost: float
    """Sum of the logarithms of the joints' mean squares of the efforts' residuals."""


class Regression:
    """Efforts that the motions required and commanded efforts, with the same filter, for regressions at any delay."""

    def __init__(
        self,
        plants: list[Plant],
        logs: list[Log],
        motions: list[Motion],
        payload: bool,
        gains_known: bool = True,
        law: Motors | None = None,
    ) -> None:
        """Take ``motions`` of ``logs``; ``law`` are values (1, joints) of the law's unknowns, by kind."""
        drive, dt = plants[0].drive, plants[0].drive.timestep
        cutoff = min(CUTOFF, 0.2 / max(float(np.median(np.diff(log.time))) for log in logs))
        blocks: list[tuple[Float64, ...]] = []
        late: list[Float64] = []
        self.plants, self.motions, self.rows = plants, motions, list[Any]()
        for plant, log, motion in zip(plants, logs, motions, strict=True):
            edge = min(round(EDGE / dt), len(motion.qpos) // 5)
            rows = np.arange(edge, len(motion.qpos) - edge, max(1, round(_EVERY / dt)))
            self.rows.append(rows)
            v, a = motion.qvel[rows], motion.qacc[rows]
            known = log.settings.payload
            empty = _motor_efforts(plant, motion, rows, known)
            per_kg = _motor_efforts(plant, motion, rows, known + 1.0) - empty if payload else np.zeros_like(empty)
            effort = motion.command if drive.params is None else _law_efforts(plant, motion, law or {})
            unloaded = np.full((len(motion.qpos), 1), known)
            if drive.through and (held := plant.compensation(motion.qpos, motion.qvel, unloaded)) is not None:
                effort = effort + held
            if drive.params is None:  # the law's efforts are computed from filtered positions
                effort = lowpass(effort, cutoff, dt)
            time = np.arange(len(effort)) * dt
            late.append(np.array([interpolated(time[rows] - d, time, effort) for d in DELAYS]))
            still = 0.01 * np.abs(v).max(0) + 1e-9
            sign = lowpass(np.clip(motion.qvel / still, -1, 1), cutoff, dt)[rows]
            blocks.append((empty, per_kg, a, v, sign))
        self._efforts = np.concatenate(late, axis=1)
        self._columns = [np.concatenate(parts) for parts in zip(*blocks, strict=True)]
        fast = np.abs(speeds := self._columns[3]) > MOVES * np.sqrt((speeds**2).mean(0))
        self._moves = fast | (fast.sum(0) < LEAST_ROWS)
        self._payload = payload
        self.gains_known, self._bounds = gains_known, [GAINS] * len(fast.T)
        self.ratios_only = np.zeros(len(fast.T), bool)
        """Joints (joints,) of which only ratios to the strength are known; it is 1 there."""
        if gains_known:
            links, efforts = ((table**2).mean(0) for table in (self._columns[0], self._efforts[0]))
            self.ratios_only = links < LEAST_SHARE**2 * efforts
            self._bounds = [TAKEN if each else STRENGTHS for each in self.ratios_only]

    def at(self, delay: float, kg: float = 0.0, strength_prior: float | Float64 = WEAK) -> FirstGuess:
        """Return the motors that explain the efforts best at a ``delay`` [s], with a payload.

        ``strength_prior`` is the weight of the prior at strength 1, of all joints or of each (joints,).
        """
        tables = self.tables(delay, kg)
        empty = tables[0]
        priors = np.broadcast_to(strength_prior, empty.shape[1])
        both = []
        for joint, rows in enumerate(self._moves.T):
            required, *columns = (table[rows, joint] for table in tables)
            prior, bounds = float(priors[joint]), self._bounds[joint]
            both.append(_solve_joint(required, columns, NO_PRIOR if bounds == GAINS else prior, bounds))
        cost = float(sum(np.log(mean + 1e-30) for mean, _ in both))
        values = [*np.array([found for _, found in both]).T[:, None], *np.array([delay, kg])[:, None, None]]
        return FirstGuess(dict(zip(FOUND, values, strict=True)), cost)

    def tables(self, delay: float, kg: float) -> tuple[Float64, ...]:
        """Return required efforts, acceleration, velocity, its sign, and the efforts so far, all (rows, joints)."""
        empty, per_kg, a, v, sign = self._columns
        place = np.clip(delay / DELAY_STEP, 0.0, len(self._efforts) - 1.001)
        below, share = int(place), place % 1.0
        effort = (1 - share) * self._efforts[below] + share * self._efforts[below + 1]
        return empty + kg * per_kg, a, v, sign, effort

    @cached_property
    def best(self) -> FirstGuess:
        """Motors at the delay, and with the payload if one is asked for, that explain the efforts best."""
        empty = self._at_best_delay(0.0)
        if not self._payload:
            return empty
        loaded = empty
        for _ in range(2):
            costs = [self.at(loaded.motors["delay"][0, 0], kg, NO_PRIOR).cost for kg in PAYLOADS]
            loaded = self._at_best_delay(PAYLOADS[int(np.argmin(costs))])
        return loaded if explains_better(loaded, empty) else empty

    def _at_best_delay(self, kg: float) -> FirstGuess:
        return min((self.at(delay, kg, NO_PRIOR) for delay in DELAYS), key=lambda start: start.cost)


def explains_better(special: FirstGuess, plain: FirstGuess) -> bool:
    """Return whether ``special`` explains the efforts significantly better than ``plain``."""
    return plain.cost - special.cost > EVIDENCE * plain.motors["armature"].shape[1]


def _law_efforts(plant: Plant, motion: Motion, law: Motors) -> Float64:
    """Return the efforts (steps, joints) of the law along a measured ``motion``, without compensation."""
    rows = [(q[None], v[None], u[None]) for q, v, u in zip(motion.qpos, motion.qvel, motion.command, strict=True)]
    control = plant.control(Actuators(), *rows[0][:2], drive=plant.drive.of(law))
    efforts = np.array([control.advance(u, q, v, None)[0].copy() for q, v, u in rows])
    return efforts if motion.feedforward is None else efforts + motion.feedforward


def required_efforts(plant: Plant, motion: Motion, rows: NDArray[np.intp], payload: float) -> Float64:
    """Return the efforts (rows, joints) that a motion with a ``payload`` [kg] requires, without compensation."""
    q, v, a = (table[rows] for table in motion[:3])
    passive = plant.at(q, v, np.full((len(q), 1), payload))
    return (passive.matrix @ a[..., None])[..., 0] + (passive.force + passive.payload_force)


def _motor_efforts(plant: Plant, motion: Motion, rows: NDArray[np.intp], payload: float) -> Float64:
    """Return the required efforts, less the compensation that does not pass through the motors."""
    effort = required_efforts(plant, motion, rows, payload)
    if plant.drive.through:
        return effort
    held = plant.compensation(motion.qpos[rows], motion.qvel[rows], np.full((len(rows), 1), payload))
    return effort if held is None else effort - held


def _solve_joint(
    required: Float64, motion: list[Float64], strength_prior: float, bounds: tuple[float, float] = STRENGTHS
) -> tuple[float, Float64]:
    """Return the mean square of the residual, and armature, damping, friction, strength and bias of a joint.

    ``motion`` is acceleration, velocity, its sign, and the commanded effort (rows,); ``bounds`` are of the strength.
    """
    from scipy.optimize import lsq_linear

    a, v, sign, effort = motion
    columns = np.stack([a, v, sign, -effort, -np.ones_like(a)], axis=1)
    size = np.abs(columns).max(0) + 1e-12
    matrix = columns / size
    weights = np.array([_PRIOR, _PRIOR, _PRIOR, strength_prior / size[3], _PRIOR])
    prior = (weights * (np.sqrt((effort**2).mean()) + 1e-9)) ** 2 * len(a)
    information = matrix.T @ matrix + np.diag(prior)
    target = -matrix.T @ required + prior * np.array([0, 0, 0, size[3], 0])
    root = np.linalg.cholesky(information + 1e-12 * np.eye(5))
    low = np.array([0, 0, 0, bounds[0], -np.inf]) * size
    high = np.array([np.inf, np.inf, np.inf, bounds[1], np.inf]) * size
    found = lsq_linear(root.T, np.linalg.solve(root, target), (low, high)).x
    return float(((matrix @ found + required) ** 2).mean()), found / size
