"""Causes for which a run does not settle: the envs, the joint, the time, and the remedy.

A joint has settled if it ends within its band: 2 % of its move, and 1e-3 rad or 1e-4 m at least.
:data:`RULES` is the table of causes; an env has the first that fits one of its joints outside their
bands. The functions at the end write reports of runs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from tabulate import tabulate

from batchpid.arrays.array_types import Bool, Float64, Rows
from batchpid.arrays.elementwise import TURN, wrap
from batchpid.errors import InvalidArgumentError
from batchpid.metrics import SETTLING_SHARE
from batchpid.sim.diagnosis.preflight import touching_links
from batchpid.sim.findings import LIMIT_TOLERANCE, Finding, Findings

if TYPE_CHECKING:
    from batchpid.sim.robot.robot import Robot
    from batchpid.sim.rollout import Rollout

EXAMINED = 100  # envs at most
TAIL = 0.2  # last share of the run, by which joints are judged
MOST_CAUSES = 3  # of a report
TOUCH = 3e-3  # distance below which links touch, within the accuracy of meshes [m]


def absolute_band(robot: Robot) -> Float64:
    """Return the least half width of the settling band, per joint (dof,) [rad or m]."""
    return np.array([1e-4 if joint.type == "prismatic" else 1e-3 for joint in robot.joints])


def joint_difference(robot: Robot, difference: Rows) -> Rows:
    """Return a difference of positions (..., dof) [rad or m], of continuous joints the short way
    round.
    """
    return wrap(difference, robot.continuous / TURN, np)


def unsettled_findings(rollout: Rollout, robot: Robot) -> Findings:
    """Return the causes for which joints of a ``rollout`` of ``robot`` do not settle, in the order
    of :data:`RULES`.

    Every finding has the envs and the time [s] from which the joint hardly moved in the first of
    them, or at which that env failed. Only failures are found where setpoints are not joint
    positions, and no more than :data:`EXAMINED` envs are examined.
    """
    if robot.joint_names != rollout.info.joint_names:
        problem = f"{robot.name!r} has other joints than the run of {rollout.info.robot!r}"
        raise InvalidArgumentError("robot", problem, remedy="give the robot of the run")
    findings = Findings()
    if not len(rollout.time):
        return findings
    envs = np.flatnonzero(_Run(rollout, robot).unsettled.any(1))[:EXAMINED]
    if not len(envs):
        return findings
    run = _Run(rollout.for_envs(envs), robot)
    unexplained = run.unsettled.copy()
    # Of one cause the joint that is farthest from its setpoint comes first.
    farthest = np.argsort(-np.abs(run.error[run.tail]).max((0, 1)))
    for code, test in RULES.items():
        names_joint = code not in OF_ENVS
        fits = unexplained & test(run)
        is_concerned = fits.any(1)
        unexplained[is_concerned] = False
        if not names_joint:
            fits[:, farthest[0]] = is_concerned
        for joint in farthest if names_joint else farthest[:1]:
            rows = np.flatnonzero(fits[:, joint])
            if len(rows):
                findings.append(_finding(run, code, joint, rows, envs))
    return findings


def _finding(
    run: _Run,
    code: str,
    joint: int,
    rows: NDArray[np.intp],
    envs: NDArray[np.intp],
) -> Finding:
    """Return one finding for the same cause in ``rows`` of the examined ``envs``, with the detail
    of the first.
    """
    times = run.rest_time[rows, joint]
    rows = rows[np.argsort(times, kind="stable")]
    first = rows[0]
    name = None
    detail = run.pressed[first]
    if code not in OF_ENVS:
        name = run.robot.joint_names[joint]
        detail = f"{run.error[-1, first, joint]:.2g} {run.robot.units[joint]} remain"
    for fault in run.info.faults:
        if run.failed[first] and fault.env == first:
            detail = f"{fault.joint}: {fault.cause}"
    return Finding.of(
        code,
        joint=name,
        detail=detail,
        envs=tuple(envs[rows].tolist()),
        time=times.min(),
    )


class _Run:
    """Arrays of a run, and figures of its end (envs, dof)."""

    def __init__(self, rollout: Rollout, robot: Robot) -> None:
        self.rollout = rollout
        self.robot = robot
        self.info = rollout.info
        ticks = len(rollout.time)
        self.tail = slice(-min(ticks, max(3, round(TAIL * ticks))), None)
        self.qpos = rollout.qpos.astype(np.float64)
        self.failed: Bool = np.asarray(~rollout.ok.all(0))[:, None]
        self.goal: Float64 = self.qpos[-1]
        """Joint positions at the last setpoints; the end where they are unknown."""
        if self.info.sets_positions:
            self.goal = robot.coupling.positions(rollout.setpoint[-1])
        self.error = joint_difference(robot, self.goal - self.qpos)
        """Last setpoint minus each position (ticks, envs, dof) [rad or m]."""
        self.band = np.maximum(SETTLING_SHARE * np.abs(self.error[0]), absolute_band(robot))
        """Half width of the settling band [rad or m]."""
        outside = (np.abs(self.error[-1]) > self.band) | self.failed
        self.unsettled: Bool = outside & robot.independent
        """Joints that end outside their band, and all joints of envs that failed."""

    @cached_property
    def limit(self) -> Float64:
        """Largest effort [N m or N]."""
        params = self.info.params
        limit = self.info.effort_limit
        if params is not None and params.effort_max is not None:
            limit = params.effort_max
        return np.broadcast_to(limit, self.band.shape)

    @cached_property
    def effort(self) -> Float64:
        """Effort (ticks, envs, dof), of a drive from its law."""
        effort = self.rollout.effort.astype(np.float64)
        params = self.info.params
        if self.info.control == "drive" and params is not None:
            law = params.kp * self.error
            if params.kd is not None:
                law = law - params.kd * self.rollout.qvel
            effort += np.clip(law, -self.limit, self.limit)
        return effort

    @cached_property
    def load(self) -> Float64:
        """Effort that holds the robot against gravity at the end, and at the setpoints (2, envs,
        dof).
        """
        ends = np.stack([self.qpos[-1], self.goal])
        if not self.robot.fixed_base:
            return np.zeros_like(ends)
        poses = np.nan_to_num(ends.reshape(-1, self.robot.dof))
        return self.robot.dynamics().holding_efforts(poses).reshape(ends.shape)

    @cached_property
    def is_at_rest(self) -> Bool:
        """Joints whose motion in a second is a small share of their error, or of their band."""
        seconds = -self.tail.start * self.rollout.tick
        motion = np.ptp(self.error[self.tail], axis=0) / min(1.0, seconds)
        return np.asarray(motion < np.maximum(0.05 * np.abs(self.error[-1]), 0.2 * self.band))

    @cached_property
    def buzzes(self) -> Bool:
        """Joints that are fast at the end and yet stay where they are, since their effort
        alternates.
        """
        change = np.median(np.abs(np.diff(self.qpos[self.tail], axis=0)), axis=0)
        speed = np.median(np.abs(self.rollout.qvel[self.tail]), axis=0)
        return np.asarray(speed > 3 * change / self.rollout.tick + 1e-2)

    @cached_property
    def rest_time(self) -> Float64:
        """Time from which each joint stays within its band around its last position, or at which
        its env failed [s].
        """
        away = np.abs(self.qpos - self.qpos[-1]) > self.band
        away[0] = True
        rest = len(away) - np.argmax(away[::-1], axis=0)
        failure = np.argmin(self.rollout.ok, axis=0)[:, None]
        ticks = np.where(self.failed, failure, np.minimum(rest, len(away) - 1))
        times: Float64 = self.rollout.time[ticks]
        return times

    @cached_property
    def pressed(self) -> list[str]:
        """Nearest links at the end, per env, that a step of the unsettled joints towards their
        setpoints brings nearer still; "" if there are none.
        """
        links = [""] * len(self.failed)
        most = 20 * absolute_band(self.robot)
        steps = np.clip(self.error[-1], -most, most) * self.unsettled
        # A floating base stands on its ground.
        ground = bool(self.info.ground and self.robot.fixed_base)
        for env in np.flatnonzero(~self.failed & (self.info.collisions is not False)):
            end = self.qpos[-1, env]
            before = touching_links(self.robot, end, ground, TOUCH)
            # Links that slide along each other are pressed by single joints, not by all at once.
            moves = [steps[env], *np.diag(steps[env])] if before else []
            pressed = set[str]()
            for move in moves:
                after = touching_links(
                    self.robot, self.robot.coupling.positions(end + move), ground, TOUCH
                )
                pressed |= {pair for pair in before if after.get(pair, TOUCH) < before[pair] - 1e-4}
            links[env] = min(pressed, key=before.__getitem__, default="")
        return links


def _is_beyond_limits(run: _Run) -> Bool:
    low = run.robot.lower - LIMIT_TOLERANCE
    high = run.robot.upper + LIMIT_TOLERANCE
    return ~run.robot.continuous & ((run.goal < low) | (run.goal > high))


def _oscillates(run: _Run) -> Bool:
    """Return the joints that buzz, or swing about their setpoint in the last half."""
    wave = run.error[len(run.error) // 2 :]
    ends = run.error[run.tail]
    turns = np.count_nonzero(np.diff(np.sign(wave - wave.mean(0)), axis=0), axis=0)
    is_large = np.ptp(ends, axis=0) / 2 >= np.maximum(np.abs(ends.mean(0)), run.band / 2)
    return np.asarray(run.buzzes | (is_large & (turns >= 3)))


def _is_too_weak(run: _Run) -> Bool:
    at_limit = np.mean(np.abs(run.effort) >= 0.999 * run.limit, axis=0) > 0.5
    needed = np.abs(run.load).max(0) + run.robot.friction
    blocked: Bool = at_limit & ~run.buzzes & (~run.is_at_rest | (needed >= 0.95 * run.limit))
    return blocked


def _is_blocked(run: _Run) -> Bool:
    """Return the joints whose effort neither gravity nor friction explains, in envs at rest."""
    applied = np.median(run.effort[run.tail], axis=0)
    noise = 0.05 * (np.abs(applied) + np.abs(run.load[0]))
    unexplained = np.abs(applied - run.load[0])
    stuck: Bool = run.is_at_rest.all(1, keepdims=True) & (
        unexplained > 1.2 * run.robot.friction + noise
    )
    return stuck


# Facts come before symptoms: an env that failed, setpoints that cannot be reached, links that
# touch. An effort at its limit and oscillations come before rest, since such a joint can rest for a
# moment. A force that the model does not explain comes before gains that are small, which would
# explain any error at rest.
RULES: dict[str, Callable[[_Run], Bool]] = {
    "failed": lambda run: run.failed,
    "out-of-limits": _is_beyond_limits,
    "guard": lambda run: run.rollout.guarded[-1],
    "touching": lambda run: np.array(run.pressed)[:, None] != "",
    "effort-limit": _is_too_weak,
    "oscillates": _oscillates,
    "blocked": _is_blocked,
    "gains": lambda run: run.is_at_rest,
    "slow": lambda run: run.unsettled,
}
"""Every cause, a kind of finding, in the order in which they are tested and listed: whether the
joints (envs, dof) have it, or the envs (envs, 1).
"""
OF_ENVS = ("failed", "touching")
"""Causes of whole envs, which name no joint."""


def table(rows: Sequence[Sequence[str]], headers: Sequence[str], align: str) -> str:
    """Return ``rows`` under ``headers`` as text; ``align`` has one letter per column, "l" or
    "r".
    """
    sides = tuple("left" if side == "l" else "right" for side in align)
    return tabulate(rows, headers, disable_numparse=True, colalign=sides)


def cause_lines(findings: Sequence[Finding]) -> Iterator[str]:
    """Yield a line for each of the first causes, the most likely first."""
    for cause in findings[:MOST_CAUSES]:
        yield f"WHY: {cause.where}: {cause.text} ({cause.figures}); {cause.remedy}."
    if len(findings) > MOST_CAUSES:
        yield f"and {len(findings) - MOST_CAUSES} more, which rollout.findings() lists."


def overshoot_of_settled(overshoot: Rows, settling: Rows) -> Rows:
    """Return the overshoots of joints that settled; NaN for the others, of which it says
    nothing.
    """
    return np.where(np.isinf(settling) & np.isfinite(overshoot), np.nan, overshoot)


def median_and_worst(figures: Rows, style: str) -> str:
    """Return the median and the worst of ``figures``, "never" for infinity, and "-" where none is
    defined.
    """
    if np.isnan(figures).all():
        return "-"
    # Infinite figures allow no interpolation between two of them.
    quantiles = np.nanquantile(figures, [0.5, 1.0], method="higher")
    return " / ".join("never" if math.isinf(value) else style.format(value) for value in quantiles)
