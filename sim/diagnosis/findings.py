"""Causes for which a run does not settle: the envs, the joint or the links, the time, and the remedy.

A joint has settled if it ends within its band: 2 % of its move, and 1e-3 rad or 1e-4 m at least. :data:`RULES` is the
table of causes. A rule finds places, each a joint or links of an env, among the joints that no earlier rule explains.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import defaultdict
from collections.abc import Callable, Iterator
from functools import cached_property
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import batchpid.task_space as ts
from batchpid.arrays.array_types import Bool, Float64
from batchpid.arrays.elementwise import TURN
from batchpid.errors import BatchPIDError, InvalidArgumentError
from batchpid.sim.observation import Rollout
from batchpid.sim.robot.description import LIMIT_TOLERANCE, RobotDescription
from batchpid.sim.robot.findings import Finding, Findings
from batchpid.sim.robot.loop_stability import StabilityReport, stability_report
from batchpid.task_space.frames import pose_error

REVOLUTE_BAND, PRISMATIC_BAND = 1e-3, 1e-4
"""Least half width of the settling band [rad], [m]."""
BAND = 0.02
"""Half width of the settling band, as a share of the move."""
POSE_BAND = 2e-3
"""Error [m, rad] within which a tool has reached its pose."""
EXAMINED = 100
"""Largest number of envs that are examined."""
TAIL = 0.2
"""Last share of the run, by which joints are judged."""
TOUCH, OVERLAP = 3e-3, 1e-3
"""Distance [m] below which links touch, within the accuracy of meshes; depth [m] from which they overlap."""
STEP = {"rad": 0.02, "m": 0.005}
"""Largest step towards the setpoint that shows whether a joint presses links together."""
Links = tuple[str, ...]
"""Names of two links, or of one, which touches the ground."""


def absolute_band(robot: RobotDescription) -> Float64:
    """Return the least half width of the settling band, per joint (dof,) [rad or m]."""
    return np.array([PRISMATIC_BAND if joint.type == "prismatic" else REVOLUTE_BAND for joint in robot.joints])


def settled_envs(rollout: Rollout, robot: RobotDescription) -> Bool:
    """Return the envs of a ``rollout`` of ``robot`` that have not failed and whose joints all settle (envs,)."""
    return np.asarray(~_Run(rollout, robot).unsettled.any(1))


def unsettled_findings(rollout: Rollout, robot: RobotDescription) -> Findings:
    """Return the causes for which joints of a ``rollout`` of ``robot`` do not settle, the most likely first.

    The cause that is the first in most envs comes first, then the one that is first in :data:`RULES`. Every finding has
    the envs, the time [s] at which it began in the first of them, and a joint or links. Empty if all joints settle, and
    where setpoints are neither joint positions nor poses of a tool, unless an env failed. Of more than
    :data:`EXAMINED` envs that do not settle, as many are examined, evenly chosen.

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
    envs = np.flatnonzero(_Run(rollout, robot).unsettled.any(1))
    if not len(envs):
        return Findings()
    if len(envs) > EXAMINED:
        envs = envs[np.linspace(0, len(envs) - 1, EXAMINED).astype(int)]
    run = _Run(rollout.for_envs(envs), robot)
    unexplained, is_first = run.unsettled.copy(), np.ones(len(envs), bool)
    causes: dict[tuple[int, int | None, Links], list[_Location]] = defaultdict(list)
    times_first: dict[tuple[int, int | None, Links], int] = defaultdict(int)
    for rank, rule in enumerate(RULES):
        for place in [*rule.find(run, unexplained)]:
            key = rank, place.joint, place.links
            causes[key].append(place)
            times_first[key] += is_first[place.env]
            is_first[place.env] = False
            unexplained[place.env, slice(None) if rule.explains_env else place.joint] = False
    order = sorted(causes, key=lambda key: (-times_first[key], key[0], -len(causes[key])))
    return Findings([run.finding(RULES[key[0]], causes[key], envs) for key in order])


class _Location(NamedTuple):
    """Joint or links of an env that have a cause, since a time [s], with figures."""

    env: int
    time: float
    joint: int | None = None
    links: Links = ()
    detail: str = ""


class _Run:
    """Arrays of a rollout, and figures of its end."""

    def __init__(self, rollout: Rollout, robot: RobotDescription) -> None:
        self.rollout, self.robot, self.info = rollout, robot, rollout.info
        ticks = len(rollout.time)
        self.tail = slice(-min(ticks, max(3, round(TAIL * ticks))), None)
        self.qpos = rollout.qpos.astype(np.float64)
        start = self.info.start
        self.start: Float64 = np.asarray(self.qpos[0] if start is None else start, np.float64)
        self.failed: Bool = np.asarray(~rollout.ok.all(0))
        command = self.info.own_command
        self.is_pose = command is not None and self.info.tool is not None and command.size == 7
        self.collides = self.info.collisions is not False

    def finding(self, rule: Rule, places: list[_Location], envs: NDArray[np.intp]) -> Finding:
        """Return one finding for the same cause in several envs; ``envs`` are their numbers in the whole run."""
        places = sorted(places, key=lambda place: place.time)
        first = places[0]
        other = f"link {first.links[1]!r}" if len(first.links) > 1 else "the ground"
        return Finding(
            "warning",
            rule.code,
            rule.text.format(other=other),
            rule.remedy,
            joint=None if first.joint is None else self.robot.joint_names[first.joint],
            link=first.links[0] if first.links else None,
            detail=first.detail,
            envs=tuple(envs[[place.env for place in places]].tolist()),
            time=float(first.time),
        )

    # -- the end of the run: arrays (envs, dof), with the ticks first where they are named -----------------------------

    @cached_property
    def solution(self) -> Any:
        """Joint positions that bring the tool to the last setpoints, from the ends of the run."""
        pose = self.rollout.setpoint[-1, :, :7].copy()
        pose[:, 3:] /= np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)
        end = np.nan_to_num(self.qpos[-1])
        return ts.inverse_kinematics(self.robot.rigid_tree, self.info.tool or "", pose, end, on_failure="return")

    @cached_property
    def goal(self) -> Float64 | None:
        """Joint positions at the last setpoints, of a pose those nearest to the end; None if unknown."""
        if self.info.own_command is None and self.info.control != "effort":
            return self.robot.coupled(self.rollout.setpoint[-1])
        goal: Float64 | None = self.solution.qpos if self.is_pose and self.robot.fixed_base else None
        return goal

    def _short_way(self, error: Float64) -> Float64:
        return np.where(self.robot.continuous, error - TURN * np.rint(error / TURN), error)

    @cached_property
    def error(self) -> Float64:
        """Last setpoint minus each position (ticks, envs, dof) [rad or m]; 0 where setpoints are unknown."""
        return np.zeros_like(self.qpos) if self.goal is None else self._short_way(self.goal - self.qpos)

    @cached_property
    def band(self) -> Float64:
        """Half width of the settling band [rad or m]."""
        move = np.zeros_like(self.start) if self.goal is None else self._short_way(self.goal - self.start)
        return np.maximum(BAND * np.abs(move), absolute_band(self.robot))

    @cached_property
    def unsettled(self) -> Bool:
        """Joints that end outside their band, and all joints of failed envs."""
        share = np.abs(self.error[-1]) / self.band
        outside = share > 1
        if self.is_pose and self.rollout.tool_pose is not None and self.goal is not None:
            left = pose_error(self.rollout.setpoint[-1, :, :7], self.rollout.tool_pose[-1].astype(float))
            # The joints that are farthest from the pose, though maybe within their bands, keep the tool from it.
            outside = (np.abs(left).max(1) > POSE_BAND)[:, None] & (share >= np.minimum(1, share.max(1))[:, None])
        return np.asarray((outside | self.failed[:, None]) & self.robot.independent)

    @cached_property
    def limit(self) -> Float64:
        """Largest effort [N m or N]."""
        params = self.info.params
        limit = self.info.effort_limit if params is None or params.effort_max is None else params.effort_max
        return np.broadcast_to(limit, self.start.shape)

    def gain(self, name: str) -> Float64:
        """Return the gains kp, ki or kd; NaN where they are unknown or have no effect."""
        params = self.info.params
        if params is None or self.info.control not in ("pid", "drive"):
            return np.full_like(self.start, np.nan)
        leaf = getattr(params, name)
        return np.zeros_like(self.start) + (0.0 if leaf is None else leaf)

    @cached_property
    def effort(self) -> tuple[Float64, Bool]:
        """Effort and whether it was limited (ticks, envs, dof); of a drive from its law."""
        effort, saturated = self.rollout.effort.astype(np.float64), self.rollout.saturated
        if self.info.control != "drive" or self.info.params is None:
            return effort, saturated
        drive = self.gain("kp") * self.error - self.gain("kd") * self.rollout.qvel
        return effort + np.clip(drive, -self.limit, self.limit), np.abs(drive) >= self.limit

    @cached_property
    def applied(self) -> Float64:
        """Effort at the end, the median of the tail."""
        return np.asarray(np.median(self.effort[0][self.tail], axis=0))

    @cached_property
    def at_limit(self) -> Bool:
        """Joints whose effort is at its limit at the end."""
        return np.asarray(self.effort[1][self.tail].mean(0) > 0.5)

    @cached_property
    def load(self) -> Float64:
        """Effort that holds the robot against gravity at the end, and at the setpoints (2, envs, dof)."""
        ends = np.stack([self.qpos[-1], self.start if self.goal is None else self.goal])
        if not self.robot.fixed_base:
            return np.zeros_like(ends)
        poses = np.nan_to_num(ends.reshape(-1, self.robot.dof))
        return self.robot.holding_efforts(poses).reshape(ends.shape)

    @cached_property
    def needed(self) -> Float64:
        """Effort that gravity needs at most, without friction."""
        return np.asarray(np.abs(self.load).max(0))

    @cached_property
    def unexplained_effort(self) -> Float64:
        """Part of the effort at the end that does not carry gravity."""
        return np.abs(self.applied - self.load[0])

    def _moves_less(self, motion: Float64, share: float) -> Bool:
        """Return the joints whose motion in the tail is less than a share of their error, or within their band."""
        return motion < np.maximum(share * np.abs(self.error[-1]), 0.2 * self.band)

    @cached_property
    def is_at_rest(self) -> Bool:
        """Joints that hardly move in a second at the end, or in the tail if that is longer."""
        seconds = max(1.0, -self.tail.start * self.rollout.tick)
        return self._moves_less(seconds * np.abs(self.rollout.qvel[self.tail].mean(0)), 0.05)

    @cached_property
    def env_is_at_rest(self) -> Bool:
        """Envs in which no joint moves at the end (envs, 1)."""
        motion = np.ptp(self.error[self.tail], axis=0)
        return np.asarray(self._moves_less(motion, 0.01).all(1, keepdims=True))

    @cached_property
    def oscillates(self) -> Bool:
        """Joints that swing about their setpoint in the last half."""
        wave, ends = self.error[len(self.error) // 2 :], self.error[self.tail]
        turns = np.count_nonzero(np.diff(np.sign(wave - wave.mean(0)), axis=0), axis=0)
        is_large = np.ptp(ends, axis=0) / 2 >= np.maximum(np.abs(ends.mean(0)), self.band / 2)
        return np.asarray(is_large & (turns >= 3))

    @cached_property
    def delay(self) -> Float64:
        """Delays and lags of motors and sensors [s]."""
        delay, actuators = np.zeros_like(self.start), self.info.actuators
        for name in () if actuators is None else ("command_delay", "sensor_delay", "lag"):
            leaf = getattr(actuators, name)
            delay = delay if leaf is None else delay + leaf
        return delay

    @cached_property
    def rest_time(self) -> Float64:
        """Time from which each joint stays within its band around its last position [s]."""
        away = np.abs(self.qpos - self.qpos[-1]) > self.band
        last = np.where(away.any(0), len(away) - 1 - np.argmax(away[::-1], axis=0), 0)
        return self.rollout.time[np.minimum(last + 1, len(away) - 1)]

    def figures(self, env: int, joint: int) -> str:
        """Return the error of a joint at the end, its effort, and the effort that it needs."""
        place, unit = (env, joint), self.robot.joints[joint].effort_unit
        left = f"{self.error[-1][place]:.2g} {self.robot.units[joint]} remain"
        efforts = f"with {self.applied[place]:.3g} of {self.limit[place]:.3g} {unit}"
        return f"{left}, {efforts}; gravity {self.needed[place]:.3g}, friction {self.robot.friction[joint]:.3g}"

    def place_of_setpoint(self, env: int, joint: int) -> str:
        """Return the setpoint of a joint, and its limits."""
        assert self.goal is not None
        low, high = self.robot.lower[joint], self.robot.upper[joint]
        return f"{self.goal[env, joint]:.4g} {self.robot.units[joint]}, limits [{low:g}, {high:g}]"

    # -- contacts and stability, of one env ----------------------------------------------------------------------------

    def near(self, qpos: Float64, within: float = TOUCH) -> dict[Links, float]:
        """Return the distances [m] below ``within`` of pairs of links, of one link to the ground, nearest first.

        A robot on a floating base stands on the ground: there only pairs of links count.
        """
        ground = self.info.ground if self.robot.fixed_base else False
        pairs = sorted(self.robot.dynamics(ground).contacts.near(qpos, within), key=itemgetter(2), reverse=True)
        nearest = {tuple(filter(None, pair)): distance for *pair, distance in pairs}
        return dict(sorted(nearest.items(), key=itemgetter(1)))

    def pushing_joint(self, env: int, links: Links, distance: float) -> int | None:
        """Return the unsettled joint whose step towards the setpoint brings ``links`` nearest; None if none does."""
        closest, pushing = distance - 1e-4, None
        for joint in np.flatnonzero(self.unsettled[env]).tolist():
            step, moved = STEP[self.robot.units[joint]], self.qpos[-1, env].copy()
            moved[joint] += np.clip(self.error[-1, env, joint], -step, step)
            apart = self.near(self.robot.coupled(moved), 2 * TOUCH).get(links, 2 * TOUCH)
            if apart < closest:
                closest, pushing = apart, joint
        return pushing

    def stability(self, env: int) -> StabilityReport | None:
        """Return the share of the stability range that an env's gains use at its end, at its start if it failed."""
        info, row = self.info, np.array([env])
        if info.control != "pid" or info.params is None or info.timestep is None:
            return None
        motors = None if info.actuators is None else info.actuators.for_envs(row)
        pose = self.start[env] if self.failed[env] else self.qpos[-1, env]
        try:
            return stability_report(self.robot, info.params.for_envs(row), pose, info.timestep, actuators=motors)
        except BatchPIDError:  # a mass matrix that is not positive definite
            return None


# -- rules -----------------------------------------------------------------------------------------------------------

Find = Callable[[_Run, Bool], Iterator[_Location]]
"""Function (run, joints without a cause (envs, dof)) that yields the places of a cause."""


def _joints(test: Callable[[_Run], Bool], detail: Callable[[_Run, int, int], str] = _Run.figures) -> Find:
    """Return the function that finds the joints for which a ``test`` is true (envs, dof): the latest, the farthest."""

    def find(run: _Run, unexplained: Bool) -> Iterator[_Location]:
        places = np.argwhere(unexplained & ~run.failed[:, None] & test(run))
        delay, farthest = run.delay, np.abs(run.error[run.tail]).max(0)
        for env, joint in sorted(places.tolist(), key=lambda place: (-delay[*place], -farthest[*place])):
            yield _Location(env, run.rest_time[env, joint], joint, detail=detail(run, env, joint))

    return find


def _envs(look: Callable[[_Run, int], Iterator[_Location]]) -> Find:
    """Return the function that looks at each env with unexplained joints."""

    def find(run: _Run, unexplained: Bool) -> Iterator[_Location]:
        for env in np.flatnonzero(unexplained.any(1)).tolist():
            yield from look(run, env)

    return find


def _faults(are_of_input: bool) -> Find:
    """Return the function that finds the failed envs whose fault is one of the input, or of the state."""

    def look(run: _Run, env: int) -> Iterator[_Location]:
        fault = next((fault for fault in reversed(run.info.faults) if fault.env == env), None)
        cause = "state" if fault is None else fault.cause
        if run.failed[env] and are_of_input == (cause not in ("state", "speed")):
            time = run.rollout.time[np.argmin(run.rollout.ok[:, env])] if fault is None else fault.time
            names = run.robot.joint_names
            joint = names.index(fault.joint) if fault is not None and fault.joint in names else None
            yield _Location(env, float(time), joint, detail=cause)

    return _envs(look)


def _unstable(run: _Run, env: int) -> Iterator[_Location]:
    """Yield the joint that takes the largest part in a motion beyond the bound, where efforts or speeds show it."""
    report = run.stability(env)
    if report is None or report.robot_ratio < 1:
        return
    rollout, tail = run.rollout, run.tail
    speed = np.abs(rollout.qvel[tail, env]).mean(0)
    moved = np.abs(np.diff(run.qpos[tail, env], axis=0)).mean(0) / rollout.tick
    shaking = (speed > 3 * moved + 1e-2) | run.at_limit[env] | run.oscillates[env]
    if run.failed[env] or shaking[run.unsettled[env]].any():
        detail = f"{report.robot_ratio:.3g} times the bound"
        yield _Location(env, float(rollout.time[0]), int(np.argmax(report.participation)), detail=detail)


def _start_contacts(run: _Run, env: int) -> Iterator[_Location]:
    """Yield the pairs of links that overlap at the start, the deepest first."""
    if run.collides and run.info.start is not None:
        time = float(run.rollout.time[0] - run.rollout.tick)
        for links, distance in run.near(run.start[env], -OVERLAP).items():
            yield _Location(env, time, links=links, detail=f"{-1e3 * distance:.3g} mm deep")


def _contacts(run: _Run, env: int) -> Iterator[_Location]:
    """Yield the pairs of links that a joint presses together at the end, the nearest first."""
    if not run.collides or run.goal is None or run.failed[env]:
        return
    for links, distance in run.near(run.qpos[-1, env]).items():
        joint = run.pushing_joint(env, links, distance)
        if joint is not None:
            tick = bisect_left(range(len(run.qpos)), True, key=lambda tick: links in run.near(run.qpos[tick, env]))
            detail = f"joint {run.robot.joint_names[joint]!r} pushes"
            yield _Location(env, float(run.rollout.time[tick]), links=links, detail=detail)


def _out_of_reach(run: _Run, env: int) -> Iterator[_Location]:
    if run.is_pose and run.goal is not None and not (run.solution.success[env] or run.failed[env]):
        away = 1e3 * float(run.solution.position_error[env])
        detail = f"the nearest is {away:.3g} mm away" if away > 1e3 * POSE_BAND else "its rotation is not reached"
        yield _Location(env, run.rest_time[env].max(), links=(str(run.info.tool),), detail=detail)


class Rule(NamedTuple):
    """Cause for which joints do not settle, in a sentence, with the remedy and the function that finds its places."""

    code: str
    text: str
    remedy: str
    find: Find
    explains_env: bool = False
    """True if the other joints of the env are not examined, since their errors may follow from it."""


def _is_beyond_limits(run: _Run) -> Bool:
    low, high = run.robot.lower - LIMIT_TOLERANCE, run.robot.upper + LIMIT_TOLERANCE
    if run.is_pose or run.goal is None:
        return np.zeros_like(run.unsettled)
    return ~run.robot.continuous & ((run.goal < low) | (run.goal > high) | (run.robot.lower == run.robot.upper))


def _setpoint_moves(run: _Run) -> Bool:
    if run.is_pose or run.goal is None:
        return np.zeros_like(run.unsettled)
    return (np.ptp(run.rollout.setpoint[run.tail], axis=0) > run.band) & ~run.at_limit


def _is_blocked(run: _Run) -> Bool:
    """Return the joints whose effort neither gravity nor friction explains, in envs at rest."""
    noise = 0.05 * (np.abs(run.applied) + np.abs(run.load[0]))
    return run.env_is_at_rest & run.is_at_rest & (run.unexplained_effort > 1.2 * run.robot.friction + noise)


def _stands(run: _Run, share: float) -> Bool:
    """Return the joints at rest whose error in the tail has not fallen below a ``share``, or has nothing to fall."""
    error = np.abs(run.error[run.tail])
    return run.is_at_rest & ((run.gain("ki") == 0) | (error[-1] > share * error[0]))


def _is_held_by_friction(run: _Run) -> Bool:
    friction = run.robot.friction
    return _stands(run, 0.95) & (friction > 0) & (run.unexplained_effort > 0.02 * friction)


def _lacks_integral_action(run: _Run) -> Bool:
    params = run.info.params
    has_limit = params is not None and params.integral_max is not None
    return _stands(run, 0.98) & ((run.gain("ki") == 0) | has_limit)


# Facts come before symptoms: a fault of the input, setpoints that cannot be reached, links that touch, gains beyond the
# bound. Each of them explains errors of all joints. Then come the motion and the effort of each joint at its end, the
# causes of an effort at its limit and of oscillations before those of rest, since such a joint can rest for a moment.
# Among these, a force that the model does not explain is a cause only where the whole env is at rest.
RULES: tuple[Rule, ...] = (
    Rule(
        "setpoint-not-finite",
        "was given a number that is not finite",
        "correct the input",
        _faults(are_of_input=True),
        True,
    ),
    Rule(
        "out-of-reach",
        "no pose within the joint limits brings the tool to the setpoint",
        "move it nearer",
        _envs(_out_of_reach),
        True,
    ),
    Rule(
        "setpoint-limits",
        "the setpoint is outside the joint limits, and that error remains",
        "move it inside, or correct <limit lower= upper=>",
        _joints(_is_beyond_limits, _Run.place_of_setpoint),
        True,
    ),
    Rule(
        "guard",
        "the guard holds the setpoint back",
        "move the setpoint inside the guard's limits, or give it more time",
        _joints(lambda run: run.rollout.guarded[-1]),
        True,
    ),
    Rule(
        "start-touching",
        "starts inside {other}",
        "use another start pose, correct the collision shapes, disable the pair in an .srdf, or use ground=False",
        _envs(_start_contacts),
        True,
    ),
    Rule(
        "touching",
        "is pressed against {other}",
        "choose another setpoint or way, disable the pair in an .srdf if it only seems to touch, or use ground=False",
        _envs(_contacts),
        True,
    ),
    Rule(
        "unstable",
        "the gains are beyond the stability bound of the sampled loop: the effort alternates, or oscillates",
        "use at most half the gains that reach the bound, a derivative_filter_time, or robot.designed()",
        _envs(_unstable),
        True,
    ),
    Rule(
        "diverged",
        "its state is no longer finite, although the gains are within the stability bound",
        "lower the gains or the time step: contacts and fast motion lower the bound",
        _faults(are_of_input=False),
        True,
    ),
    Rule(
        "moving",
        "the setpoint still moves when the run ends, and the joint lags behind it",
        "hold the last setpoint, or pass setpoint_rate",
        _joints(_setpoint_moves),
    ),
    Rule(
        "no-gains",
        "kp and ki are 0: nothing moves it to the setpoint",
        "give it gains",
        _joints(lambda run: (run.gain("kp") == 0) & (run.gain("ki") == 0)),
    ),
    Rule(
        "weak",
        "the effort is at its limit, which gravity and friction alone exceed",
        "raise the effort limit, lighten the load, or choose a pose that needs less",
        _joints(lambda run: run.at_limit & (run.needed + run.robot.friction >= 0.95 * run.limit)),
    ),
    Rule(
        "oscillates",
        "oscillates: its loop is hardly damped, or motors and sensors are too late for its gains",
        "raise its kd, lower its kp and ki, or use robot.designed()",
        _joints(lambda run: run.oscillates),
    ),
    Rule(
        "effort-limit",
        "the effort is at its limit, and the move takes longer than the run",
        "run longer, move less far, or raise the effort limit",
        _joints(lambda run: ~run.is_at_rest & (run.at_limit | (run.effort[1].mean(0) > 0.5))),
    ),
    Rule(
        "blocked",
        "something that the robot's model does not hold acts on it: an object, a payload, another force",
        "look at the scene; for a constant load use gains with integral action",
        _joints(_is_blocked),
    ),
    Rule(
        "friction",
        "friction holds it: the effort does not exceed it",
        "use gains with integral action, compensate='gravity+coriolis+friction', or a higher effort limit",
        _joints(_is_held_by_friction),
    ),
    Rule(
        "no-integral",
        "rests beside the setpoint: without integral action, or with the integral at its limit, the error remains that "
        "balances the load",
        "give it a ki, raise integral_limit, or compensate gravity",
        _joints(_lacks_integral_action),
    ),
    Rule(
        "slow",
        "still approaches the setpoint when the run ends",
        "run longer, or raise the gains",
        _joints(lambda run: run.unsettled),
    ),
)
"""Every cause. An earlier rule explains a joint before a later one, and its findings are listed first."""
