"""Preflight: what is odd about a robot and the way it is to be run, told before the first step.

SAPIEN accepts most of what is listed here without a word (each finding's ``code`` is described in
docs/reliability.md). What it cannot run at all is an error of ``Robot.load``; a finding is what it runs otherwise
than the URDF, or the user, means.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

import batchpid as bp
from batchpid.errors import InvalidArgumentError
from batchpid.validate import array, choice, number, within
from sim.robot.description import RobotDescription
from sim.robot.dissipation import DISSIPATION
from sim.robot.stability import stability
from sim.robot.urdf import Joint, mimic_works

SEVERITIES = ("error", "warning", "note")
"""Will not do what is asked; probably does something else than meant; good to know."""

NEAR_BOUND = 0.5
"""Share of the stability range from which on gains are told of: the range shrinks in lighter poses."""


@dataclass(frozen=True)
class Finding:
    """One thing that is odd: what, on which joint or link, and what to do about it.

    ``severity`` is one of :data:`SEVERITIES`; ``code`` names the kind of finding, for programs.
    """

    severity: str
    code: str
    text: str
    remedy: str
    joint: str | None = None
    link: str | None = None

    @property
    def where(self) -> str:
        """``"joint 'x'"``, ``"link 'x'"`` or ``"robot"``."""
        if self.joint is not None:
            return f"joint {self.joint!r}"
        return "robot" if self.link is None else f"link {self.link!r}"

    def __str__(self) -> str:
        return f"{self.severity}: {self.where}: {self.text}; {self.remedy}"


def check(
    robot: RobotDescription,
    *,
    params: bp.PIDParams | None = None,
    qpos: ArrayLike | None = None,
    setpoint: ArrayLike | None = None,
    timestep: float = 1 / 2000,
    control: str = "pid",
) -> list[Finding]:
    """Return the findings, most severe first; :meth:`sim.Robot.check` describes the arguments."""
    timestep = number("timestep", timestep, 1e-6, 0.1, "seconds")
    choice("control", control, ("pid", "drive", "effort"))
    names = robot.joint_names
    start = robot.start if qpos is None else within("qpos", array("qpos", qpos, (1, robot.dof), names), 1e6, names)[0]
    findings = [*_links(robot), *_joints(robot), *_base(robot), *_poses(robot, "start pose", start)]
    if setpoint is not None:
        findings += _poses(robot, "setpoint", array("setpoint", setpoint, (1, robot.dof), names)[0])
    findings += _touching(robot, start)
    if params is not None:
        if not isinstance(params, bp.PIDParams) or params.num_joints != robot.dof:
            raise InvalidArgumentError(
                "params",
                f"must be PIDParams of {robot.dof} joints",
                value=type(params).__name__ if not isinstance(params, bp.PIDParams) else params.num_joints,
                remedy="build them with robot.params()",
            )
        findings += _params(robot, params, control)
        if control == "pid":
            findings += _stability(robot, params, start, timestep)
    return sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity))


def _links(robot: RobotDescription) -> Iterator[Finding]:
    moved_by = {joint.child_link: joint for joint in robot.all_joints}
    for link in robot.links:
        if link.inertial or (robot.fixed_base and link.name not in moved_by):
            continue
        carrier = moved_by.get(link.name)
        rigid = carrier is not None and not carrier.moves
        if link.collisions:
            effect = "SAPIEN takes its mass from the collision shapes, at 1000 kg/m^3"
        elif rigid:
            effect = "SAPIEN makes it a link of 1e-6 kg, which costs time in every step"
        else:
            effect = "SAPIEN makes it a link of 1e-6 kg: the joint that moves it is all but impossible to control"
        yield Finding(
            "note" if rigid else "warning",
            "no-inertia",
            f"no mass and inertia of its own; {effect}",
            "add <inertial> with mass and inertia, or merge it into its parent",
            link=link.name,
        )
    if robot.missing_meshes:
        yield Finding(
            "warning",
            "missing-mesh",
            f"collision meshes not found, simulated without: {', '.join(robot.missing_meshes)}",
            "pass package_dirs=[...] to Robot.load",
        )


def _joints(robot: RobotDescription) -> Iterator[Finding]:
    imposed = DISSIPATION[robot.dissipation].joint_friction
    for joint in robot.joints:
        name = joint.name
        if joint.friction and imposed is None:
            yield Finding(
                "warning",
                "friction",
                f"friction {joint.friction:g}: URDF means {joint.effort_unit}, PhysX a coefficient that multiplies "
                "the load on the joint",
                "expect another steady-state error than from Coulomb friction, or set it to 0",
                joint=name,
            )
        if imposed is not None and joint.friction != imposed:
            yield Finding(
                "note",
                "friction",
                f"friction {joint.friction:g} of the URDF is replaced by SAPIEN's default {imposed:g}",
                "load with dissipation='urdf' to have the URDF's",
                joint=name,
            )
        if joint.mimic is not None:
            yield _mimic(joint, robot)
        if joint.continuous:
            yield Finding(
                "note",
                "continuous",
                "its position wraps: qpos jumps by whole turns",
                "build params with robot.params(), which takes errors and rates the short way round",
                joint=name,
            )
        if joint.lower == joint.upper:
            yield Finding(
                "warning",
                "no-range",
                f"its limits are [{joint.lower:g}, {joint.upper:g}] {joint.unit}: it cannot move",
                "give <limit lower= upper=>, or make it fixed",
                joint=name,
            )
        elif not joint.continuous and math.isinf(joint.upper - joint.lower):
            yield Finding(
                "note",
                "no-limits",
                "it has no position limits",
                "give <limit lower= upper=>, so that setpoints can be checked",
                joint=name,
            )
        if joint.effort_limit == 0:
            yield Finding(
                "warning",
                "zero-effort",
                "its effort limit is 0: no controller that keeps it can move it",
                "give <limit effort=>, or pass effort_limit= to robot.params()",
                joint=name,
            )
        elif math.isinf(joint.effort_limit):
            yield Finding(
                "note",
                "no-effort-limit",
                "it has no effort limit, so efforts are not saturated",
                "give <limit effort=>, or pass effort_limit= to robot.params()",
                joint=name,
            )


def _mimic(joint: Joint, robot: RobotDescription) -> Finding:
    mimic = joint.mimic
    assert mimic is not None
    law = f"mimics {mimic.joint!r} (multiplier {mimic.multiplier:g}, offset {mimic.offset:g})"
    if mimic_works(joint, robot.all_joints):
        return Finding(
            "note",
            "mimic",
            f"{law}: a stiff tendon couples the two, and it is still one of the {robot.dof} degrees of freedom",
            "give both joints the same setpoint",
            joint=joint.name,
        )
    return Finding(
        "warning",
        "mimic",
        f"{law}, which SAPIEN would get wrong: left out, the joint moves by itself",
        f"command it as {mimic.multiplier:g} * {mimic.joint} + {mimic.offset:g}",
        joint=joint.name,
    )


def _base(robot: RobotDescription) -> Iterator[Finding]:
    if not robot.fixed_base:
        yield Finding(
            "warning",
            "floating-base",
            "on a floating base SAPIEN's passive force holds no gravity",
            "load with fixed_base=True, or expect no compensation",
        )


def _poses(robot: RobotDescription, what: str, qpos: NDArray[np.float64]) -> Iterator[Finding]:
    for _, index, value in robot.limit_violations(qpos):
        joint = robot.joints[index]
        effect = "SAPIEN flings it back" if what == "start pose" else "the joint cannot reach it"
        yield Finding(
            "warning",
            "out-of-limits",
            f"{what} {value:g} {joint.unit} is outside [{joint.lower:g}, {joint.upper:g}]: {effect}",
            "move it inside",
            joint=joint.name,
        )


def _touching(robot: RobotDescription, start: NDArray[np.float64]) -> Iterator[Finding]:
    if robot.dynamics().touches(start[None])[0]:
        yield Finding(
            "warning",
            "touching",
            "links overlap, or dip into the ground, at the start pose: SAPIEN pushes them apart",
            "start elsewhere, correct the collision shapes, or disable the pair in an .srdf beside the URDF",
        )


def _stability(
    robot: RobotDescription, params: bp.PIDParams, start: NDArray[np.float64], timestep: float
) -> Iterator[Finding]:
    report = stability(robot, params, start, timestep)
    if report.robot < NEAR_BOUND:
        return
    unstable = report.robot >= 1
    severity, code = ("warning", "unstable") if unstable else ("note", "near-unstable")
    effect = "it diverges, alternating from step to step" if unstable else "it may diverge in other poses"
    yield Finding(
        severity,
        code,
        f"the sampled PID loop is at {report.robot:.2g} times its stability bound at the start pose: {effect}",
        f"take at most {0.5 / report.robot:.1g} times these gains, a derivative_filter_time, or gain_units='inertia'",
    )
    for index in np.flatnonzero(report.ratio >= NEAR_BOUND):
        joint = robot.joints[index]
        yield Finding(
            severity,
            code,
            f"kd*dt/I = {report.kd_dt[index]:.3g}, kp*dt^2/I = {report.kp_dt2[index]:.2g} at its inertia of "
            f"{report.inertia[index]:.2g} {'kg' if joint.type == 'prismatic' else 'kg m^2'}: "
            f"{report.ratio[index]:.2g} times the bound that it has by itself",
            f"take at most {0.5 / report.ratio[index]:.1g} times its kd and kp",
            joint=joint.name,
        )


def _params(robot: RobotDescription, params: bp.PIDParams, control: str) -> Iterator[Finding]:
    wraps = np.zeros((1, robot.dof)) if params.continuous is None else np.asarray(params.continuous)
    for joint, wrapped in zip(robot.joints, (wraps != 0).any(axis=0), strict=True):
        if joint.continuous and not wrapped and control == "pid":
            yield Finding(
                "warning",
                "continuous",
                "params do not say that it is continuous: the error jumps by a turn where qpos wraps",
                "pass continuous= to make_params, or use robot.params()",
                joint=joint.name,
            )
        if wrapped and not joint.continuous:
            yield Finding(
                "warning",
                "continuous",
                "params call it continuous, the URDF does not: the short way round may lie beyond its limits",
                "leave it out of continuous=",
                joint=joint.name,
            )
    if control == "drive" and params.ki is not None and np.any(np.asarray(params.ki)):
        yield Finding(
            "warning",
            "drive-integral",
            "PhysX's drive has no integral: ki is ignored",
            "use control='pid', or ki=0",
        )
