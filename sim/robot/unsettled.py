"""Causes for which a run does not settle: the envs, the joint or the links, the time, and the remedy.

A joint has settled if it ends within its band: 2 % of its move, and 1e-3 rad or 1e-4 m at least. The causes of an env
are looked for in this order, from facts to symptoms: a fault of its input or its state, setpoints outside the limits or
out of reach, links that start in contact or are pressed together, gains beyond the stability bound, and then, for each
joint, whether it is at rest, oscillates or still moves, compared with the effort that gravity and friction need. Joints
of an env in which links are pressed together are not examined further: their errors follow from the contact.

Longer than 350 lines because every cause is here, with its evidence and its message.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import batchpid.task_space as ts
from batchpid.arrays.array_types import Array, Bool, Float64, Rows
from batchpid.arrays.elementwise import TURN
from batchpid.errors import BatchPIDError, InvalidArgumentError
from batchpid.gains.stability import Oscillation
from batchpid.sim.observation import Rollout
from batchpid.sim.robot.description import LIMIT_TOLERANCE, RobotDescription
from batchpid.sim.robot.findings import Finding, Findings
from batchpid.sim.robot.loop_stability import StabilityReport, implicit_remedy, slow_oscillation, stability_report
from batchpid.task_space.frames import pose_error

REVOLUTE_BAND, PRISMATIC_BAND = 1e-3, 1e-4
"""Least half width of the settling band [rad], [m]."""
BAND = 0.02
"""Half width of the settling band, as a share of the move."""
EXAMINED = 100
"""Largest number of envs that are examined."""
TAIL = 0.2
"""Last share of the run, by which joints are judged."""
TOUCH, OVERLAP = 3e-3, 1e-3
"""Distance [m] below which links touch, within the accuracy of meshes; depth [m] from which they overlap."""
STEP = {"rad": 0.02, "m": 0.005}
"""Largest step towards the setpoint that shows whether a joint presses links together."""
TIMED = 4
"""Envs of a pair of links whose first contact is looked for."""
RINGING = 0.2
"""Damping ratio below which a loop rings."""
POSE_BAND = 2e-3
"""Error [m, rad] within which a tool has reached its pose."""


class Words(NamedTuple):
    """Words for one kind of cause: in a cell of a table, in a sentence, and the remedy."""

    short: str
    text: str
    remedy: str


CAUSES: dict[str, Words] = {
    "setpoint-not-finite": Words("bad input", "was given a number that is not finite", "correct the input"),
    "unstable": Words(
        "unstable",
        "the gains are beyond the stability bound of the sampled loop: the effort alternates, or oscillates",
        "use at most half the gains that reach the bound, a derivative_filter_time, {implicit}or robot.designed()",
    ),
    "setpoint-limits": Words(
        "out of limits", "the setpoint is outside the joint limits, and that error remains", "move it inside"
    ),
    "out-of-reach": Words(
        "out of reach", "no pose within the joint limits brings the tool to the setpoint", "move it nearer"
    ),
    "start-in-ground": Words(
        "starts in ground",
        "starts inside the ground",
        "use another start pose, raise the base, or run with ground=False",
    ),
    "start-touching": Words(
        "starts touching",
        "starts inside link {other!r}",
        "use another start pose, correct the collision shapes, or disable the pair in an .srdf",
    ),
    "ground": Words(
        "ground", "is pressed into the ground", "choose a setpoint and a way above it, or run with ground=False"
    ),
    "links": Words(
        "links touch",
        "is pressed against link {other!r}",
        "choose another setpoint or way, or disable the pair in an .srdf if it only seems to touch",
    ),
    "guard": Words(
        "guard",
        "the guard holds the setpoint back",
        "move the setpoint inside the guard's limits, or give it more time",
    ),
    "no-gains": Words("no gains", "kp and ki are 0: nothing moves it to the setpoint", "give it gains"),
    "no-range": Words("no range", "its limits have no range: it cannot move", "correct <limit lower= upper=>"),
    "weak": Words(
        "too weak",
        "the effort is at its limit, which gravity and friction alone exceed",
        "raise the effort limit, lighten the load, or choose a pose that needs less",
    ),
    "friction": Words(
        "friction",
        "friction holds it: the effort does not exceed it",
        "use gains with integral action, compensate='gravity+coriolis+friction', or a higher effort limit",
    ),
    "blocked": Words(
        "blocked",
        "something that the robot's model does not hold acts on it: an object, a payload, another force",
        "look at the scene; for a constant load use gains with integral action",
    ),
    "effort-limit": Words(
        "effort limit",
        "the effort is at its limit, and the move takes longer than the run",
        "run longer, move less far, or raise the effort limit",
    ),
    "moving": Words(
        "still moving",
        "the setpoint still moves when the run ends, and the joint lags behind it",
        "hold the last setpoint, or pass setpoint_rate",
    ),
    "ringing": Words(
        "rings", "the loop is hardly damped and rings", "raise its kd, lower its kp and ki, or use robot.designed()"
    ),
    "oscillates": Words(
        "oscillates",
        "oscillates, although its gains are within the stability bound of ideal motors",
        "lower the gains: delays and lags of motors and sensors lower the bound",
    ),
    "no-integral": Words(
        "no integral",
        "rests beside the setpoint: without integral action the error remains that balances the load",
        "give it a ki, or compensate gravity",
    ),
    "integral-limit": Words(
        "integral limit", "rests beside the setpoint with its integral at the limit", "raise integral_limit"
    ),
    "slow": Words("too slow", "still approaches the setpoint when the run ends", "run longer, or raise the gains"),
    "diverged": Words(
        "diverged",
        "its state is no longer finite, although the gains are within the stability bound of ideal motors",
        "lower the gains or the time step: delays of motors, contacts and fast motion lower the bound",
    ),
}
"""Every cause by its code, in the order in which causes of the same number of envs are listed."""
_RANK = {code: rank for rank, code in enumerate(CAUSES)}


def absolute_band(robot: RobotDescription) -> Float64:
    """Return the least half width of the settling band, per joint (dof,) [rad or m]."""
    return np.array([PRISMATIC_BAND if joint.type == "prismatic" else REVOLUTE_BAND for joint in robot.joints])


def short_words(findings: Findings, joint: str | None = None) -> str:
    """Return the words for a cell of a table: for the first finding of ``joint``, else the first; "never" for none."""
    of_joint = [each for each in findings if each.joint == joint]
    first = next(iter([*of_joint, *findings]), None)
    return "never" if first is None else CAUSES[first.code].short


def settled_envs(rollout: Rollout, robot: RobotDescription) -> Bool:
    """Return the envs of a ``rollout`` of ``robot`` that have not failed and whose joints all settle (envs,)."""
    run = _Run(rollout, robot)
    settled: Bool = ~(run.failed | run.unsettled.any(1))
    return settled


def unsettled_findings(rollout: Rollout, robot: RobotDescription) -> Findings:
    """Return the causes for which joints of a ``rollout`` of ``robot`` do not settle, the most likely first.

    The cause of the most envs is first. Every finding has the envs, the time [s] at which it began in the first of
    them, and a joint or a link. Empty if all joints settle, and where setpoints are neither joint positions nor poses
    of a tool, unless an env failed. Of more than :data:`EXAMINED` envs that do not settle, as many are examined, evenly
    chosen.

    Raises
    ------
    InvalidArgumentError
        The robot has other joints than the run.
    """
    if robot.joint_names != rollout.info.joint_names:
        problem = f"{robot.name!r} has other joints than the run of {rollout.info.robot!r}"
        raise InvalidArgumentError("robot", problem, remedy="give the robot of the run")
    if not len(rollout.time):
        return Findings()
    run = _Run(rollout, robot)
    causes: dict[tuple[Any, ...], list[tuple[int, _Cause]]] = defaultdict(list)
    first: dict[tuple[Any, ...], int] = defaultdict(int)
    for env in run.examined.tolist():
        for place, cause in enumerate(run.causes(env)):
            key = cause.code, cause.joint, cause.links
            causes[key].append((env, cause))
            first[key] += place == 0
    found = sorted(causes, key=lambda key: (-first[key], _RANK[key[0]], -len(causes[key])))
    return Findings(run.finding(causes[key]) for key in found)


class _Cause(NamedTuple):
    """Cause in one env: its code, its joint or links, its time [s], and figures."""

    code: str
    time: float
    joint: int | None = None
    links: tuple[str, ...] = ()
    detail: str = ""


@dataclass(frozen=True)
class _Run:
    """Arrays of a run and figures of its end."""

    rollout: Rollout
    robot: RobotDescription

    def finding(self, causes: list[tuple[int, _Cause]]) -> Finding:
        """Return one finding for the same cause in several envs."""
        causes = sorted(causes, key=lambda each: each[1].time)
        code, time, joint, links, detail = causes[0][1]
        words, params = CAUSES[code], self.rollout.info.params
        other = links[1] if len(links) > 1 else ""
        remedy = words.remedy.format(implicit="" if params is None else implicit_remedy(params))
        return Finding(
            "warning",
            code,
            words.text.format(other=other),
            remedy,
            joint=None if joint is None else self.robot.joint_names[joint],
            link=links[0] if links else None,
            detail=detail,
            envs=tuple(env for env, _ in causes),
            time=float(time),
        )

    # -- figures of the end ------------------------------------------------------------------------------------------

    @cached_property
    def start(self) -> Float64:
        """Positions before the first tick (envs, dof); after it, if they are not known."""
        start = self.rollout.info.start
        return np.asarray(self.rollout.qpos[0] if start is None else start, np.float64)

    @cached_property
    def is_pose(self) -> bool:
        """Whether setpoints are poses of a tool."""
        own = self.rollout.info.own_command
        return own is not None and self.rollout.info.tool is not None and own.size == 7

    @cached_property
    def goal(self) -> Float64 | None:
        """Joint positions (envs, dof) at the last setpoints, of a pose those nearest to the end; None if unknown."""
        info, last = self.rollout.info, self.rollout.setpoint[-1]
        if info.own_command is None and info.control != "effort":
            return self.robot.coupled(last)
        if not self.is_pose or info.tool is None or not self.robot.fixed_base:
            return None
        goal = self.start.copy()
        goal[self.examined] = self._solution.qpos
        return goal

    @cached_property
    def _solution(self) -> Any:
        """Joint positions that bring the tool to the last setpoints, from the ends of the examined envs."""
        info, envs = self.rollout.info, self.examined
        pose = self.rollout.setpoint[-1, envs, :7].copy()
        pose[:, 3:] /= np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)
        ended = np.nan_to_num(self.rollout.qpos[-1, envs].astype(np.float64))
        return ts.inverse_kinematics(self.robot.rigid_tree, info.tool or "", pose, ended, on_failure="return")

    @cached_property
    def error(self) -> Float64:
        """Last setpoint minus each position (ticks, envs, dof) [rad or m], the short way round."""
        assert self.goal is not None
        error = self.goal - self.rollout.qpos
        return np.where(self.robot.continuous, error - TURN * np.rint(error / TURN), error)

    @cached_property
    def band(self) -> Float64:
        """Half width of the settling band (envs, dof) [rad or m]."""
        assert self.goal is not None
        move = self.goal - self.start
        move = np.where(self.robot.continuous, move - TURN * np.rint(move / TURN), move)
        return np.maximum(BAND * np.abs(move), absolute_band(self.robot))

    @cached_property
    def failed(self) -> Bool:
        """Envs that failed (envs,)."""
        return np.asarray(~self.rollout.ok.all(0))

    @cached_property
    def unsettled(self) -> Bool:
        """Joints that end outside their band (envs, dof); failed envs do not count."""
        shape = self.rollout.qpos.shape[1:]
        outside: Any
        if self.is_pose and self.rollout.tool_pose is not None and self.robot.fixed_base:
            left = pose_error(self.rollout.setpoint[-1, :, :7], self.rollout.tool_pose[-1].astype(float))
            outside = np.broadcast_to((np.abs(left).max(1) > POSE_BAND)[:, None], shape)
        elif self.is_pose or self.goal is None:
            outside = np.zeros(shape, bool)
        else:
            outside = np.abs(self.error[-1]) > self.band
        return np.where(self.failed[:, None] | ~self.robot.independent, False, outside)

    @cached_property
    def examined(self) -> NDArray[np.intp]:
        """Envs to examine: those that failed or do not settle, EXAMINED of them at most."""
        envs = np.flatnonzero(self.failed | self.unsettled.any(1))
        return envs if len(envs) <= EXAMINED else envs[np.linspace(0, len(envs) - 1, EXAMINED).astype(int)]

    @cached_property
    def tail(self) -> slice:
        """Ticks of the end by which joints are judged."""
        ticks = len(self.rollout.time)
        return slice(-min(ticks, max(3, round(TAIL * ticks))), None)

    def limit(self, env: int) -> tuple[Float64, Float64]:
        """Return the least and the largest effort of an env (dof,) [N m or N]."""
        params, bound = self.rollout.info.params, self.rollout.info.effort_limit
        low, high = (None, None) if params is None else (params.effort_min, params.effort_max)
        return (-bound if low is None else _row(low, env)), (bound if high is None else _row(high, env))

    def _delay(self, env: int) -> Float64:
        """Return the delays and lags of the motors and sensors of an env (dof,) [s]."""
        total, actuators = np.zeros(self.robot.dof), self.rollout.info.actuators
        for name in () if actuators is None else ("command_delay", "sensor_delay", "lag"):
            if (leaf := getattr(actuators, name)) is not None:
                total = total + _row(leaf, env)
        return total

    def gains(self, env: int) -> tuple[Float64, Float64] | None:
        """Return kp and ki of an env (dof,); None if they are unknown or have no effect."""
        params = self.rollout.info.params
        if params is None or self.rollout.info.control not in ("pid", "drive"):
            return None
        kp, zero = _row(params.kp, env), np.zeros(self.robot.dof)
        return kp + zero, zero if params.ki is None else _row(params.ki, env) + zero

    # -- causes ------------------------------------------------------------------------------------------------------

    def causes(self, env: int) -> Iterator[_Cause]:
        """Yield the causes in one env, the most likely first."""
        if self.failed[env]:
            yield from self._failure(env)
            return
        if self.is_pose and self.robot.fixed_base and not self._solution.success[row := self._row_of(env)]:
            away = 1e3 * float(self._solution.position_error[row])
            detail = f"the nearest is {away:.3g} mm away" if away > 1e3 * POSE_BAND else "its rotation is not reached"
            yield _Cause("out-of-reach", self._rest(env), links=(str(self.rollout.info.tool),), detail=detail)
            return
        left: list[int] = np.flatnonzero(self.unsettled[env]).tolist()
        for joint in list(left):
            if (beyond := self._beyond_limits(env, joint)) is not None:
                yield beyond
                left.remove(joint)
        if not left:
            return
        if pressed := [*self._contacts(env)]:
            yield from pressed
            return
        if self._was_thrown(env):
            yield from self._start_contacts(env, OVERLAP)
        if (unstable := self._unstable(env, left)) is not None:
            yield unstable
            return
        farthest, delay = np.abs(self.error[self.tail, env]).max(0), self._delay(env)
        found = [self._of_joint(env, joint) for joint in left]
        if len(left) < np.count_nonzero(self.unsettled[env]):  # others push a limit, which disturbs these
            left, found = _without(left, found, ("slow", "effort-limit"))
        order = [(_RANK[cause.code], -delay[joint], -farthest[joint]) for cause, joint in zip(found, left, strict=True)]
        yield from (found[place] for place in sorted(range(len(found)), key=order.__getitem__))

    def _row_of(self, env: int) -> int:
        return int(np.searchsorted(self.examined, env))

    def _failure(self, env: int) -> Iterator[_Cause]:
        """Yield the causes for which an env failed."""
        rollout, robot = self.rollout, self.robot
        tick = int(np.argmin(rollout.ok[:, env]))
        time = float(rollout.time[tick])
        fault = next((each for each in reversed(rollout.info.faults) if each.env == env), None)
        joint = None
        if fault is not None:
            time = fault.time
            joint = robot.joint_names.index(fault.joint) if fault.joint in robot.joint_names else None
            if fault.cause not in ("state", "speed"):
                yield _Cause("setpoint-not-finite", time, joint, detail=fault.cause)
                return
        finite = np.isfinite(rollout.qpos[:tick, env]).all(1)
        worst = self._stability(env, self.start[env], *rollout.qpos[:tick, env][finite][-1:])
        if worst is not None and worst.robot_ratio >= 1:
            yield _Cause("unstable", time, int(np.argmax(worst.participation)), detail=_times(worst))
            return
        starts = [*self._start_contacts(env, OVERLAP)]
        yield from starts
        if not starts:
            yield _Cause("diverged", time, joint)

    def _beyond_limits(self, env: int, joint: int) -> _Cause | None:
        """Return the cause of a joint whose setpoint is outside its limits or held back."""
        robot, rollout = self.robot, self.rollout
        low, high = robot.lower[joint], robot.upper[joint]
        if low == high:
            return _Cause("no-range", float(rollout.time[0]), joint, detail=f"[{low:g}, {high:g}]")
        assert self.goal is not None
        if not self.is_pose:
            value, unit = self.goal[env, joint], robot.units[joint]
            if not robot.continuous[joint] and not low - LIMIT_TOLERANCE <= value <= high + LIMIT_TOLERANCE:
                detail = f"{value:.4g} {unit}, limits [{low:g}, {high:g}]"
                return _Cause("setpoint-limits", self._rest(env, joint), joint, detail=detail)
            if rollout.guarded[-1, env, joint]:
                since = int(np.argmax(rollout.guarded[:, env, joint]))
                return _Cause("guard", float(rollout.time[since]), joint)
        return None

    def _contacts(self, env: int) -> Iterator[_Cause]:
        """Yield the pairs of links that the joints press together at the end, or that overlap since the start."""
        if not self._collides:
            return
        starts = {cause.links: cause for cause in self._start_contacts(env, OVERLAP)}
        ticks = np.unique(
            np.linspace(len(self.rollout.time) + self.tail.start, len(self.rollout.time) - 1, 4).astype(int)
        )
        touching: dict[tuple[str, ...], list[int]] = defaultdict(list)
        for tick in ticks.tolist():
            qpos = self.rollout.qpos[tick, env].astype(np.float64)
            for links, distance in self._near(qpos).items():
                pushing = [*self._pushing(env, tick, links, distance)]
                if pushing or (links in starts and distance < -OVERLAP):
                    touching[links].append(pushing[0] if pushing else -1)
        touching = {links: joints for links, joints in touching.items() if len(joints) > len(ticks) / 2}
        assert self.goal is not None
        at_goal = self._near(self.goal[env], 0.0)
        depth = {links: -at_goal.get(links, 0.0) for links in touching}
        for links in sorted(touching, key=lambda links: -depth[links]):
            joint = touching[links][-1]
            parts = [] if joint < 0 else [f"joint {self.robot.joint_names[joint]!r} pushes"]
            if links in starts:
                yield starts[links]
                continue
            if depth[links] > OVERLAP:
                parts.append(f"at the setpoint {1e3 * depth[links]:.3g} mm deep")
            code = "ground" if len(links) == 1 else "links"
            yield _Cause(code, self._touch_time(env, links), links=links, detail=", ".join(parts))

    def _pushing(self, env: int, tick: int, links: tuple[str, ...], distance: float) -> Iterator[int]:
        """Yield the unsettled joints whose step towards the setpoint brings ``links`` nearer, the nearest first."""
        qpos = self.rollout.qpos[tick, env].astype(np.float64)
        closer = {}
        for joint in np.flatnonzero(self.unsettled[env]).tolist():
            step, moved = STEP[self.robot.units[joint]], qpos.copy()
            moved[joint] += np.clip(self.error[tick, env, joint], -step, step)
            apart = self._near(self.robot.coupled(moved), 2 * TOUCH).get(links, 2 * TOUCH)
            if distance - apart > 1e-4:
                closer[joint] = distance - apart
        yield from sorted(closer, key=lambda joint: -closer[joint])

    def _was_thrown(self, env: int) -> bool:
        """Return whether a joint went farther from its setpoint than it began, as links that overlap do."""
        assert self.goal is not None
        farthest = np.abs(self.error[:, env]).max(0)
        began = np.abs(np.where(self.robot.continuous, 0.0, self.goal[env] - self.start[env]))
        return bool((farthest > 1.2 * began + 5 * self.band[env])[self.unsettled[env]].any())

    def _start_contacts(self, env: int, depth: float) -> Iterator[_Cause]:
        """Yield the pairs of links that overlap at the start by ``depth`` [m] or more, the deepest first."""
        if not self._collides or self.rollout.info.start is None:
            return
        time = float(self.rollout.time[0] - self.rollout.tick)
        for links, distance in self._near(self.start[env], -depth).items():
            code = "start-in-ground" if len(links) == 1 else "start-touching"
            yield _Cause(code, time, links=links, detail=f"{-1e3 * distance:.3g} mm deep")

    @cached_property
    def _collides(self) -> bool:
        """Whether contacts were simulated."""
        return self.rollout.info.collisions is not False

    @cached_property
    def _times(self) -> dict[tuple[str, ...], int]:
        """Number of envs whose first contact was looked for, by pair of links."""
        return defaultdict(int)

    def _near(self, qpos: Float64, within: float = TOUCH) -> dict[tuple[str, ...], float]:
        """Return the distances [m] below ``within`` of pairs of links, of one link to the ground, nearest first.

        A robot on a floating base stands on the ground: there only pairs of links count.
        """
        pairs = self.robot.dynamics(self.rollout.info.ground if self.robot.fixed_base else False).near(qpos, within)
        found: dict[tuple[str, ...], float] = {}
        for first, second, distance in pairs:
            links = tuple(name for name in (first, second) if name)
            found[links] = min(distance, found.get(links, np.inf))
        return dict(sorted(found.items(), key=lambda item: item[1]))

    def _touch_time(self, env: int, links: tuple[str, ...]) -> float:
        """Return the time of the first tick of the last contact of ``links``; the end for envs that are not timed."""
        time, last = self.rollout.time, len(self.rollout.time) - 1
        self._times[links] += 1
        if self._times[links] > TIMED:
            return float(time[last])

        def touches(tick: int) -> bool:
            return links in self._near(self.rollout.qpos[tick, env].astype(np.float64))

        stride = max(1, len(time) // 100)
        earliest = last
        for tick in range(last, -1, -stride):
            if touches(tick):
                earliest = tick
            elif earliest - tick > 3 * stride:  # a contact that bounces counts as one
                break
        while earliest > 0 and touches(earliest - 1):
            earliest -= 1
        return float(time[earliest])

    def _stability(self, env: int, *poses: Rows) -> StabilityReport | None:
        """Return the largest share of the stability range that an env's gains use at ``poses``; None if unknown."""
        info = self.rollout.info
        if info.control != "pid" or info.params is None or info.timestep is None:
            return None
        motors = None if info.actuators is None else info.actuators.for_envs(slice(env, env + 1))
        params, dt = _env(info.params, env), info.timestep
        try:
            reports = [
                stability_report(self.robot, params, pose.astype(np.float64), dt, actuators=motors) for pose in poses
            ]
        except BatchPIDError:  # a mass matrix that is not positive definite
            return None
        return max(reports, key=lambda report: report.robot_ratio)

    def _unstable(self, env: int, joints: list[int]) -> _Cause | None:
        """Return the cause of an env whose gains are beyond the bound, and whose efforts or speeds show it."""
        rollout, tail = self.rollout, self.tail
        report = self._stability(env, rollout.qpos[-1, env])
        if report is not None and report.late:  # it swings far, and ends in any pose
            report = self._stability(env, self.start[env], rollout.qpos[-1, env])
        if report is None or report.robot_ratio < 1:
            return None
        speed = np.abs(rollout.qvel[tail, env]).mean(0)
        moved = np.abs(np.diff(rollout.qpos[tail, env].astype(np.float64), axis=0)).mean(0) / rollout.tick
        shaking = (speed > 3 * moved + 1e-2) | (rollout.saturated[tail, env].mean(0) > 0.5)
        if report.late:  # it oscillates slowly
            shaking |= [self._oscillation(env, joint) is not None for joint in range(len(shaking))]
        if not shaking[joints].any():
            return None
        saturated = rollout.saturated[:, env].any(1)
        time = rollout.time[int(np.argmax(saturated))] if saturated.any() else rollout.time[0]
        return _Cause("unstable", float(time), int(np.argmax(report.participation)), detail=_times(report))

    def _of_joint(self, env: int, joint: int) -> _Cause:
        """Return the cause of one joint that ends outside its band, by its motion and effort at the end."""
        rollout, robot, tail = self.rollout, self.robot, self.tail
        time, unit = rollout.time, robot.joints[joint].effort_unit
        error, band = self.error[:, env, joint], self.band[env, joint]
        effort, saturated = self._effort(env, joint)
        at_limit, applied = bool(saturated[tail].mean() > 0.5), float(np.median(effort[tail]))
        since = float(time[int(np.argmax(saturated))])
        gains, friction = self.gains(env), float(robot.friction[joint])
        ends = np.array([rollout.qpos[-1, env], self.start[env] if self.goal is None else self.goal[env]], np.float64)
        load = robot.holding_efforts(ends)[:, joint] if robot.fixed_base else np.zeros(2)
        limit = float(self.limit(env)[int(applied > 0)][joint])
        limit = abs(limit) if np.isfinite(limit) else abs(applied)
        needs = f"gravity {np.abs(load).max():.3g}" + (f" and friction {friction:.3g}" if friction else "")
        needed = np.abs(load).max() + friction
        if not self.is_pose and np.ptp(rollout.setpoint[tail, env, joint]) > band and not at_limit:
            return _Cause("moving", float(time[-1]), joint)
        if gains is not None and gains[0][joint] == gains[1][joint] == 0:
            return _Cause("no-gains", float(time[0]), joint)
        if at_limit and needed >= 0.95 * limit:
            code = "friction" if np.abs(load).max() < friction else "weak"
            return _Cause(code, since, joint, detail=f"{needs} of {limit:.3g} {unit}")
        if (turns := self._oscillation(env, joint)) is not None:
            return self._ringing(env, joint, turns)
        left = abs(error[-1]) / max(abs(error[tail][0]), 1e-12)
        if not self._is_at_rest(env, joint):
            share = float(saturated.mean())
            if at_limit or share > 0.5:
                return _Cause("effort-limit", since, joint, detail=f"{limit:.3g} {unit} for {share:.0%} of the run")
            swings = self._swings(env, joint)
            return swings or _Cause("slow", float(time[-1]), joint, detail=self._remains(env, joint))
        rest = self._rest(env, joint)
        unknown = abs(applied - load[0])
        detail = f"{self._remains(env, joint)}, with {applied:.3g} {unit}; {needs}"
        if unknown > 1.2 * friction + 0.05 * (abs(applied) + abs(load[0])):
            return _Cause("blocked", rest, joint, detail=detail)
        if at_limit:
            return _Cause("effort-limit", since, joint, detail=f"{limit:.3g} {unit}")
        no_integral = gains is not None and gains[1][joint] == 0
        if friction and unknown > 0.02 * friction and (no_integral or left > 0.95):
            return _Cause("friction", rest, joint, detail=detail)
        if no_integral:
            return _Cause("no-integral", rest, joint, detail=detail)
        stands = left > 0.98
        if stands and (params := rollout.info.params) is not None and params.integral_max is not None:
            return _Cause("integral-limit", rest, joint, detail=detail)
        return _Cause("slow", float(time[-1]), joint, detail=self._remains(env, joint))

    def _effort(self, env: int, joint: int) -> tuple[Float64, Bool]:
        """Return the effort of a joint at each tick and whether it was limited (ticks,), of a drive from its law."""
        rollout, gains, params = self.rollout, self.gains(env), self.rollout.info.params
        effort = rollout.effort[:, env, joint].astype(np.float64)
        if rollout.info.control != "drive" or gains is None or params is None:
            return effort, rollout.saturated[:, env, joint]
        kd = 0.0 if params.kd is None else (_row(params.kd, env) + np.zeros(self.robot.dof))[joint]
        low, high = (bound[joint] for bound in self.limit(env))
        drive = gains[0][joint] * self.error[:, env, joint] - kd * rollout.qvel[:, env, joint]
        return effort + np.clip(drive, low, high), (drive <= low) | (drive >= high)

    def _is_at_rest(self, env: int, joint: int) -> bool:
        """Return whether a joint hardly moves at the end, or swings about a position away from the setpoint."""
        error = self.error[self.tail, env, joint]
        drift = abs(error[: len(error) // 2].mean() - error[len(error) // 2 :].mean())
        speed = abs(self.rollout.qvel[self.tail, env, joint].mean())  # within a second, if the run is shorter
        small = max(0.05 * abs(error[-1]), 0.2 * self.band[env, joint])
        return bool(min(np.ptp(error), 3 * drift) < small and (speed < small or len(error) * self.rollout.tick > 0.2))

    def _oscillation(self, env: int, joint: int) -> float | None:
        """Return the frequency [Hz] of a joint that oscillates about its setpoint in the last half; else None."""
        error = self.error[len(self.error) // 2 :, env, joint]
        if len(error) < 8:
            return None
        steps = np.arange(len(error))
        wave = error - np.polyval(np.polyfit(steps, error, 1), steps)
        ends = self.error[self.tail, env, joint]
        if np.ptp(ends) / 2 < max(abs(ends.mean()), self.band[env, joint] / 2):
            return None
        turns = np.count_nonzero(np.diff(np.sign(wave[np.abs(wave) > 0.1 * np.abs(wave).max()])))
        return turns / (2 * len(error) * self.rollout.tick) if turns >= 3 else None

    def _ringing(self, env: int, joint: int, frequency: float) -> _Cause:
        """Return the cause of a joint that oscillates, by the damping of its loop with ideal motors."""
        crossed = np.flatnonzero(np.diff(np.sign(self.error[:, env, joint])))
        time = float(self.rollout.time[int(crossed[0]) + 1 if crossed.size else 0])
        amplitude = np.ptp(self.error[self.tail, env, joint]) / 2
        detail = f"at {frequency:.3g} Hz, by {amplitude:.2g} {self.robot.units[joint]}"
        if delay := float(self._delay(env)[joint]):
            detail += f", delays of {1e3 * delay:.3g} ms"
        slow = self._slow_oscillation(env)
        if slow is not None and slow.damping_ratio < RINGING:
            return _Cause("ringing", time, joint, detail=f"{detail}, damping ratio {float(slow.damping_ratio):.2g}")
        return _Cause("ringing" if self.rollout.info.control == "drive" else "oscillates", time, joint, detail=detail)

    def _slow_oscillation(self, env: int) -> Oscillation | None:
        """Return the least damped oscillation of an env's loop at its end, with ideal motors; None if unknown."""
        info = self.rollout.info
        if info.control != "pid" or info.params is None or info.timestep is None:
            return None
        qpos = self.rollout.qpos[-1, env].astype(np.float64)
        try:
            return slow_oscillation(self.robot, _env(info.params, env), qpos, info.timestep, 0)
        except BatchPIDError:  # a mass matrix that is not positive definite
            return None

    def _swings(self, env: int, joint: int) -> _Cause | None:
        """Return the cause of a joint that has passed its setpoint and comes back, in a loop that rings."""
        beyond, slow = np.sign(self.error[:, env, joint]) * self._is_outside(env, joint), self._slow_oscillation(env)
        if (
            slow is None
            or slow.damping_ratio >= RINGING
            or slow.participation[joint] < 0.05
            or abs(beyond.sum()) == (np.abs(beyond).sum())
        ):
            return None
        return self._ringing(env, joint, float(slow.frequency))

    def _is_outside(self, env: int, joint: int) -> Bool:
        return np.asarray(np.abs(self.error[:, env, joint]) > self.band[env, joint])

    def _remains(self, env: int, joint: int) -> str:
        return f"{self.error[-1, env, joint]:.2g} {self.robot.units[joint]} remain"

    def _rest(self, env: int, joint: int | None = None) -> float:
        """Return the time from which a joint, or every joint, stays within a band around its last position."""
        qpos, band = self.rollout.qpos[:, env], absolute_band(self.robot)
        if self.goal is not None:
            band = self.band[env]
        away = np.abs(qpos - qpos[-1]) > band
        moving = away.any(1) if joint is None else away[:, joint]
        first = len(moving) - int(np.argmax(moving[::-1])) if moving.any() else 0
        return float(self.rollout.time[min(first, len(moving) - 1)])


def _row(leaf: Array, env: int) -> Float64:
    """Return one env's row of a leaf of params (1 or envs, 1 or dof)."""
    rows = np.atleast_2d(np.asarray(leaf, np.float64))
    return rows[env if len(rows) > 1 else 0]


def _env(params: Any, env: int) -> Any:
    """Return the params of one env."""
    return params.for_envs(slice(env, env + 1)) if params.num_envs > 1 else params


def _without(joints: list[int], causes: list[_Cause], codes: tuple[str, ...]) -> tuple[list[int], list[_Cause]]:
    """Return joints and causes without the causes of some codes."""
    kept = [place for place, cause in enumerate(causes) if cause.code not in codes]
    return [joints[place] for place in kept], [causes[place] for place in kept]


def _times(report: StabilityReport) -> str:
    return f"{report.robot_ratio:.3g} times the bound"
