"""Preflight: oddities of a robot, its gains and its setpoint, reported before the first step.

SAPIEN silently accepts most of these oddities. ``Robot.load`` raises an error if SAPIEN cannot run
the file at all. A :class:`batchpid.sim.Finding` reports a robot that runs, but differently than the
URDF or the user intends.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

import batchpid as bp
from batchpid.checks.validate import array, choice, instance, number, within
from batchpid.errors import InvalidArgumentError
from batchpid.sim.diagnosis.loop_stability import (
    implicit_remedy,
    slow_oscillation,
    stability_report,
)
from batchpid.sim.robot.description import POSES, RobotDescription
from batchpid.sim.robot.findings import SEVERITIES, Finding, Findings
from batchpid.sim.robot.joint_repair import GIVE_RANGE
from batchpid.sim.robot.link_repair import DENSITY, triangle_excess
from batchpid.sim.robot.plausibility import implausible_figures

# of the triangle inequality of principal moments, above which it is reported; less is rounding
EXCESS = 0.01
# damping ratio below which gains are reported: more than a quarter is left after each period
RINGING = 0.2
# share of the stability range above which gains are reported: other poses may have less inertia
NEAR_BOUND = 0.5


def check(
    robot: RobotDescription,
    params: bp.PIDParams | None,
    qpos: ArrayLike | None,
    setpoint: ArrayLike | None,
    timestep: float,
    control: str,
) -> Findings:
    """Return the findings, most severe first; :meth:`batchpid.sim.Robot.check` describes the
    arguments.
    """
    timestep = number("timestep", timestep, 1e-6, 0.1, "seconds")
    choice("control", control, ("pid", "drive", "effort"))
    names = robot.joint_names
    start = (
        robot.start
        if qpos is None
        else within("qpos", array("qpos", qpos, (1, robot.dof), names), 1e6, names)[0]
    )
    findings = [*implausible_figures(robot), *robot.repairs, *robot.srdf.findings, *_links(robot)]
    findings += [
        *_contacts(robot, start),
        *_poses(robot, "start pose", start),
        *_joints(robot),
        *_strength(robot),
    ]
    if setpoint is not None:
        findings += _poses(robot, "setpoint", array("setpoint", setpoint, (1, robot.dof), names)[0])
    if params is not None:
        instance("params", params, bp.PIDParams, "use robot.params()")
        if params.num_joints != robot.dof:
            problem, remedy = f"must have {robot.dof} joints", "build them with robot.params()"
            raise InvalidArgumentError("params", problem, value=params.num_joints, remedy=remedy)
        findings += _params(robot, params, control)
        if control == "pid":
            findings += _stability(robot, params, start, timestep)
    return Findings(sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity)))


def _links(robot: RobotDescription) -> Iterator[Finding]:
    """Yield the links with an odd inertia tensor, or without mass or inertia of their own."""
    bodies = {name: at.link for name, at in robot.bodies.items()}
    root = bodies[robot.all_joints[0].parent_link]
    shaped = {shape.owner for shape in robot.tables.shapes}
    solid = {bodies[link.name] for link in robot.links if link.mass or link.name in shaped}
    loaded = set(solid)  # bodies with mass in them or in the links that they carry
    for joint in reversed(robot.all_joints):
        if bodies[joint.child_link] in loaded:
            loaded.add(bodies[joint.parent_link])
    for link in robot.links:
        name, body = link.name, bodies[link.name]
        excess = triangle_excess(link.inertia) if link.mass else 0.0
        if excess > EXCESS:
            text = (
                "no body has such an inertia tensor, a moment above the sum of the others:"
                " simulated as given"
            )
            detail = f"by {100 * excess:.0f} %"
            yield Finding("note", "inertia", text, "correct <inertia>", link=name, detail=detail)
        if link.mass or (robot.fixed_base and body == root):
            continue
        severity, detail = "warning" if name == body else "note", ""
        if name in shaped:
            effect = f"mass and inertia are those of the collision shapes, at {DENSITY:g} kg/m^3"
            detail = f"{robot.link_masses[name].mass:.3g} kg"
        elif name != body or body in solid:
            continue  # adds nothing to its body
        elif body in loaded:
            severity, effect = (
                "note",
                "it becomes a link of 1e-6 kg; only the links that it carries have mass",
            )
        else:
            effect = (
                "it becomes a link of 1e-6 kg, without load: gains per unit of effort cannot"
                " control it"
            )
        remedy = "add <inertial> with mass and inertia"
        yield Finding(
            severity, "no-inertia", f"no <inertial>: {effect}", remedy, link=name, detail=detail
        )


def _contacts(robot: RobotDescription, start: NDArray[np.float64]) -> Iterator[Finding]:
    """Yield findings about contacts at the start pose."""
    if left_over := robot.self_contact.left_over:
        text = (
            f"{len(left_over)} pairs that should not collide do, since PhysX's filter cannot hold"
            " them all"
        )
        yield Finding("note", "pairs-left-over", text, "disable fewer pairs in the .srdf")
    for pair in robot.self_contact.pairs:
        if pair.reason == "Default" and pair not in robot.srdf.disabled:
            text = "links that touch or overlap at the start pose do not collide with each other"
            remedy = "move their shapes 1 mm apart, or enable the pair in an .srdf"
            yield Finding(
                "note",
                "pairs-left-out",
                text,
                remedy,
                link=pair.first,
                detail=f"with {pair.second!r}",
            )
    if robot.dynamics(ground=robot.fixed_base and robot.has_ground).in_contact(start[None])[0]:
        text = "links overlap each other or the ground at the start pose: SAPIEN pushes them apart"
        remedy = (
            "use another start pose, correct the collision shapes, or load with"
            " self_collision='auto'"
        )
        yield Finding("warning", "touching", text, remedy)


def _poses(robot: RobotDescription, what: str, qpos: NDArray[np.float64]) -> Iterator[Finding]:
    for _, index, value in robot.limit_violations(qpos):
        joint = robot.joints[index]
        detail = f"{value:g} {joint.unit}, limits [{joint.lower:g}, {joint.upper:g}]"
        yield Finding(
            "warning",
            "out-of-limits",
            f"{what} outside the limits",
            "move it inside",
            joint.name,
            None,
            detail,
        )


def _joints(robot: RobotDescription) -> Iterator[Finding]:
    ranged = {
        repair.joint for repair in robot.repairs if repair.remedy == GIVE_RANGE
    }  # their repairs say so
    for joint, friction, suggested in zip(
        robot.joints, robot.friction, robot.design_effort_limit, strict=True
    ):
        name, mimic = joint.name, joint.mimic
        if friction >= joint.effort_limit > 0:
            text, remedy = (
                "friction is not below the effort limit: no motion",
                "correct one of them",
            )
            detail = f"{friction:g} {joint.effort_unit}, limit {joint.effort_limit:g}"
            yield Finding("warning", "friction", text, remedy, name, detail=detail)
        if mimic is not None:
            text = (
                "mimics another joint, one degree of freedom with it: its own setpoints and gains"
                " have no effect"
            )
            detail = f"{mimic.multiplier:g} x {mimic.joint!r}"
            yield Finding("note", "mimic", text, "command the leader", name, detail=detail)
        if joint.continuous:
            remedy = (
                "build params with robot.params(), which takes errors and rates the short way round"
            )
            yield Finding(
                "note", "continuous", "position wraps: qpos jumps by whole turns", remedy, name
            )
        elif joint.lower == joint.upper:
            remedy, detail = (
                "give <limit lower= upper=>, or make it fixed",
                f"[{joint.lower:g}, {joint.upper:g}]",
            )
            yield Finding(
                "warning",
                "no-range",
                "limits without range: no motion",
                remedy,
                name,
                detail=detail,
            )
        elif math.isinf(joint.upper - joint.lower) and name not in ranged:
            remedy = f"{GIVE_RANGE}, so that setpoints can be checked"
            yield Finding("note", "no-limits", "no position limits", remedy, name)
        if math.isinf(joint.effort_limit) and mimic is None:
            text = (
                "no effort limit: designed and tuned gains stay within these, from gravity and"
                " inertia"
            )
            remedy = "give <limit effort=>, or pass effort_limit= to robot.params()"
            detail = f"{suggested:.3g} {joint.effort_unit}"
            yield Finding("note", "no-effort-limit", text, remedy, name, detail=detail)


def _strength(robot: RobotDescription) -> Iterator[Finding]:
    """Yield the joints whose effort limit does not overcome gravity and friction in every pose."""
    load = np.abs(robot.holding_efforts(robot.sample(POSES, seed=0)))
    share = (load + robot.friction >= robot.effort_limit).mean(0)
    for at in np.flatnonzero((share > 0) & (robot.effort_limit > robot.friction)):
        joint = robot.joints[at]
        text = (
            "effort limit does not overcome gravity and friction in every pose: some cannot be held"
            " or left"
        )
        remedy = "expect no moves there, or correct <limit effort=>"
        needs = (
            f"gravity up to {load[:, at].max():.3g}, friction {joint.friction:g},"
            f" {100 * share[at]:.0f} % of poses"
        )
        detail = f"{joint.effort_limit:g} {joint.effort_unit}, {needs}"
        yield Finding("warning", "weak", text, remedy, joint.name, detail=detail)


def _stability(
    robot: RobotDescription, params: bp.PIDParams, start: NDArray[np.float64], timestep: float
) -> Iterator[Finding]:
    report = stability_report(robot, params, start, timestep, robot.actuators)
    if report.robot_ratio < 1:
        yield from _ringing(robot, params, start, timestep, report.env)
    if report.robot_ratio < NEAR_BOUND:
        return
    if params.discretization is not None:
        inertia = f"{1 / report.robot_ratio:.3g} times the inertia of the robot"
        text = f"the implicit law diverges where the model has {inertia}, or more"
        yield Finding(
            "note", "near-unstable", text, "lower its kp and kd if the model may be as far off"
        )
        return
    severity = "note"
    code = "near-unstable"
    effect = "it may diverge in other poses"
    if report.robot_ratio >= 1:
        severity = "warning"
        code = "unstable"
        effect = report.effect
    joint, ratio = (
        robot.joint_names[int(np.argmax(report.participation))],
        f"{report.robot_ratio:.3g}",
    )
    text = (
        f"the sampled PID loop is at {ratio} times its stability bound, mostly of joint {joint!r},"
        " at the start pose"
    )
    other = "" if report.late else implicit_remedy(params)
    yield Finding(
        severity, code, f"{text}: {effect}", f"{report.remedy}, {other}or robot.designed()"
    )


def _ringing(
    robot: RobotDescription,
    params: bp.PIDParams,
    start: NDArray[np.float64],
    timestep: float,
    env: int,
) -> Iterator[Finding]:
    slow = slow_oscillation(robot, params, start, timestep, env)
    zeta = float(slow.damping_ratio)
    if zeta < RINGING:
        left = math.exp(-2 * math.pi * zeta / math.sqrt(1 - zeta**2))
        text = (
            f"the PID loop rings at {slow.frequency:.2g} Hz with a damping ratio of {zeta:.2g} at"
            " the start pose"
        )
        text += f": after each period {100 * left:.0f} % of the amplitude is left"
        joint = robot.joint_names[int(np.argmax(slow.participation))]
        severity, remedy = (
            "note" if zeta > 0 else "warning",
            "raise its kd, lower its ki, or use robot.designed()",
        )
        yield Finding(severity, "ringing", text, remedy, joint)


def _params(robot: RobotDescription, params: bp.PIDParams, control: str) -> Iterator[Finding]:
    def any_env(leaf: ArrayLike | None) -> NDArray[np.bool_]:
        rows = np.zeros(robot.dof) if leaf is None else np.asarray(leaf)
        return (rows != 0).reshape(-1, robot.dof).any(0)

    dead = any_env(
        None if params.ki is None else np.asarray(params.ki) * (np.asarray(params.kp) == 0)
    )
    for joint, wraps, no_effect in zip(robot.joints, any_env(params.continuous), dead, strict=True):
        if joint.continuous and not wraps and control == "pid":
            text = (
                "continuous in the URDF, not in params: the error jumps by a turn where qpos wraps"
            )
            remedy = "pass continuous= to make_params, or use robot.params()"
            yield Finding("warning", "continuous", text, remedy, joint.name)
        if wraps and not joint.continuous:
            text = (
                "continuous in params, not in the URDF: the short way round may lie beyond the"
                " limits"
            )
            yield Finding("warning", "continuous", text, "leave it out of continuous=", joint.name)
        if no_effect and control == "drive":
            text = (
                "ki has no effect under control 'drive' where kp is 0: the integral moves the"
                " target of a stiffness"
            )
            yield Finding(
                "warning", "drive-integral", text, "give a kp > 0, or use control='pid'", joint.name
            )
