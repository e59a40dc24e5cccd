"""Preflight: oddities of a robot, its gains and its setpoint, reported before the first step.

SAPIEN silently accepts most of these oddities. ``Robot.load`` raises an error if SAPIEN cannot run
the file at all. A :class:`batchpid.sim.Finding` reports a robot that runs, but differently than the
URDF or the user intends.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

import batchpid as bp
from batchpid.arrays.array_types import Float64
from batchpid.checks.validate import array, choice, instance, number, within
from batchpid.errors import InvalidArgumentError
from batchpid.sim.diagnosis.loop_stability import slow_oscillation, stability_report
from batchpid.sim.engine.protocol import load_engine
from batchpid.sim.engine.scene_spec import SceneSpec
from batchpid.sim.robot.description import POSES, RobotDescription
from batchpid.sim.robot.findings import SEVERITIES, Finding, Findings
from batchpid.sim.robot.inertia import DENSITY, triangle_excess
from batchpid.sim.robot.parts import Joint
from batchpid.sim.robot.plausibility import changed_shapes, implausible_figures
from batchpid.sim.robot.urdf import GIVE_RANGE

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
    engine: str | None,
) -> Findings:
    """Return the findings, most severe first; :meth:`batchpid.sim.Robot.check` describes the
    arguments.
    """
    timestep = number("timestep", timestep, 1e-6, 0.1, "seconds")
    choice("control", control, ("pid", "drive", "effort"))
    names = robot.joint_names
    start = robot.start
    if qpos is not None:
        start = within("qpos", array("qpos", qpos, (1, robot.dof), names), 1e6, names)[0]
    # The robot first, then what this run adds to it.
    preflight = _Preflight(robot)
    preflight.check_robot(start)
    if setpoint is not None:
        goal = array("setpoint", setpoint, (1, robot.dof), names)[0]
        preflight.check_pose("setpoint", goal)
    if params is not None:
        instance("params", params, bp.PIDParams, "use robot.params()")
        if params.num_joints != robot.dof:
            problem = f"must have {robot.dof} joints"
            remedy = "build them with robot.params()"
            raise InvalidArgumentError("params", problem, value=params.num_joints, remedy=remedy)
        preflight.check_params(params, control)
        if control == "pid":
            preflight.check_stability(params, start, timestep)
    if engine is not None:
        chosen = load_engine(engine)
        ground = {"ground": robot.has_ground, "mjcf": robot.mjcf}
        scene = SceneSpec.of(robot, timestep, chosen.physics["accurate"], **ground)
        preflight.findings += [*chosen.refusals(scene), *chosen.shortfalls(scene)]
    return Findings(sorted(preflight.findings, key=lambda it: SEVERITIES.index(it.severity)))


class _Preflight:
    """Findings about one robot, in the order in which they are made."""

    def __init__(self, robot: RobotDescription) -> None:
        self.robot = robot
        self.findings = [*implausible_figures(robot), *robot.repairs, *robot.srdf.findings]
        self.findings += changed_shapes(robot)

    def _note(
        self,
        code: str,
        text: str,
        remedy: str,
        joint: str | None = None,
        link: str | None = None,
        detail: str = "",
    ) -> None:
        self.findings.append(Finding("note", code, text, remedy, joint, link, detail))

    def _warn(self, *parts: str, **where: str) -> None:
        self._note(*parts, **where)
        self.findings[-1] = replace(self.findings[-1], severity="warning")

    def check_robot(self, start: Float64) -> None:
        """Check links, contacts, the ``start`` (dof,), and joints."""
        self._check_links()
        self._check_contacts(start)
        self.check_pose("start pose", start)
        # Repairs of joints without a range are findings already.
        ranged = {repair.joint for repair in self.robot.repairs if repair.remedy == GIVE_RANGE}
        limits = self.robot.design_effort_limit
        for joint, friction, suggested in zip(
            self.robot.joints, self.robot.friction, limits, strict=True
        ):
            self._check_joint(joint, friction, suggested, joint.name in ranged)
        self._check_strength()

    def _check_links(self) -> None:
        """Report the links with an odd inertia tensor, or without mass or inertia of their own."""
        robot = self.robot
        bodies = {name: place.link for name, place in robot.bodies.items()}
        root = bodies[robot.all_joints[0].parent_link]
        shaped = {shape.owner for shape in robot.tables.shapes}
        solid = {bodies[link.name] for link in robot.links if link.mass or link.name in shaped}
        loaded = set(solid)  # bodies with mass in them or in the links that they carry
        for joint in reversed(robot.all_joints):
            if bodies[joint.child_link] in loaded:
                loaded.add(bodies[joint.parent_link])
        for link in robot.links:
            body = bodies[link.name]
            if link.mass:
                excess = triangle_excess(link.inertia)
            else:
                excess = 0.0
            if excess > EXCESS:
                self._note(
                    "inertia",
                    "no body has such an inertia tensor, a moment above the sum of the others:"
                    " simulated as given",
                    "correct <inertia>",
                    link=link.name,
                    detail=f"by {100 * excess:.0f} %",
                )
            is_held = robot.fixed_base and body == root
            adds_nothing = link.name not in shaped and (link.name != body or body in solid)
            if not (link.mass or is_held or adds_nothing):
                self._report_mass(link.name, link.name == body, body in loaded)

    def _report_mass(self, link: str, is_body: bool, is_loaded: bool) -> None:
        """Report a link without ``<inertial>``."""
        mass = self.robot.link_masses[link]
        report = self._warn if is_body else self._note
        effect = (
            "it becomes a link of 1e-6 kg that carries nothing: gains in efforts cannot control it"
        )
        detail = ""
        if mass.source == "shapes":
            effect = f"mass and inertia are those of the collision shapes, at {DENSITY:g} kg/m^3"
            detail = f"{mass.mass:.3g} kg"
        elif is_loaded:
            report = self._note
            effect = "it becomes a link of 1e-6 kg; only the links that it carries have mass"
        remedy = "add <inertial> with mass and inertia"
        report("no-inertia", f"no <inertial>: {effect}", remedy, link=link, detail=detail)

    def _check_contacts(self, start: Float64) -> None:
        """Report contacts at the start pose."""
        robot = self.robot
        for pair in robot.self_contact.pairs:
            if pair.reason == "Default" and pair not in robot.srdf.disabled:
                text = (
                    "links that touch or overlap at the start pose do not collide with each other"
                )
                remedy = "move their shapes 1 mm apart, or enable the pair in an .srdf"
                other = f"with {pair.second!r}"
                self._note("pairs-left-out", text, remedy, link=pair.first, detail=other)
        # A floating base starts on its ground, which is no fault.
        model = robot.dynamics(ground=robot.fixed_base and robot.has_ground)
        if model.in_contact(start[None])[0]:
            self._warn(
                "touching",
                "links overlap each other or the ground at the start pose: they are pushed apart",
                "use another start pose, correct the collision shapes, or load with"
                " self_collision='auto'",
            )

    def check_pose(self, name: str, qpos: Float64) -> None:
        """Report positions (dof,) outside the limits."""
        for _, index, value in self.robot.limit_violations(qpos):
            joint = self.robot.joints[index]
            detail = f"{value:g} {joint.unit}, limits [{joint.lower:g}, {joint.upper:g}]"
            text = f"{name} outside the limits"
            self._warn("out-of-limits", text, "move it inside", joint.name, detail=detail)

    def _check_joint(
        self,
        joint: Joint,
        friction: float,
        suggested: float,
        ranged: bool,
    ) -> None:
        """Report oddities of a joint; ``suggested`` is the effort limit of designed gains."""
        name = joint.name
        if friction >= joint.effort_limit > 0:
            text = "friction reaches the effort limit: no motion"
            detail = f"{friction:g} {joint.effort_unit}, limit {joint.effort_limit:g}"
            self._warn("friction", text, "correct one of them", name, detail=detail)
        if joint.mimic is not None:
            text = "mimics another joint: its own setpoints and gains have no effect"
            detail = f"{joint.mimic.multiplier:g} x {joint.mimic.joint!r}"
            self._note("mimic", text, "command the leader", name, detail=detail)
        elif math.isinf(joint.effort_limit):
            text = "no effort limit: designed and tuned gains use limits from gravity and inertia"
            remedy = "give <limit effort=>, or pass effort_limit= to robot.params()"
            detail = f"{suggested:.3g} {joint.effort_unit}"
            self._note("no-effort-limit", text, remedy, name, detail=detail)
        if joint.continuous:
            text = "position wraps: qpos jumps by whole turns"
            remedy = "build params with robot.params(), which takes errors the short way round"
            self._note("continuous", text, remedy, name)
        elif joint.lower == joint.upper:
            remedy = "give <limit lower= upper=>, or make it fixed"
            limits = f"[{joint.lower:g}, {joint.upper:g}]"
            self._warn(
                "no-range",
                "lower and upper limit are equal: no motion",
                remedy,
                name,
                detail=limits,
            )
        elif math.isinf(joint.upper - joint.lower) and not ranged:
            remedy = f"{GIVE_RANGE}, so that setpoints can be checked"
            self._note("no-limits", "no position limits", remedy, name)

    def _check_strength(self) -> None:
        """Report joints whose effort limit does not overcome gravity and friction in every pose."""
        robot = self.robot
        limits = robot.effort_limit
        load = np.abs(robot.holding_efforts(robot.sample(POSES, seed=0)))
        share = (load + robot.friction >= limits).mean(0)
        for index in np.flatnonzero((share > 0) & (limits > robot.friction)):
            joint = robot.joints[index]
            self._warn(
                "weak",
                "effort limit does not overcome gravity and friction in every pose: some cannot be"
                " held or left",
                "expect no moves there, or correct <limit effort=>",
                joint.name,
                detail=f"{joint.effort_limit:g} {joint.effort_unit}, gravity up to"
                f" {load[:, index].max():.3g}, friction {joint.friction:g},"
                f" {100 * share[index]:.0f} % of poses",
            )

    def check_stability(self, params: bp.PIDParams, start: Float64, timestep: float) -> None:
        """Report gains near or beyond the stability bound, and gains that ring."""
        robot = self.robot
        report = stability_report(robot, params, start, timestep, robot.actuators)
        ratio = report.robot_ratio
        if ratio < 1:
            self._check_ringing(params, start, timestep, report.env)
        if ratio >= NEAR_BOUND and params.discretization is not None:
            text = (
                f"the implicit law diverges if the model's inertia is {1 / ratio:.3g} times the"
                " robot's, or more"
            )
            remedy = "lower kp and kd if the model may be that wrong"
            self._note("near-unstable", text, remedy)
        elif ratio >= NEAR_BOUND:
            joint = robot.joint_names[int(np.argmax(report.participation))]
            text = (
                f"the sampled PID loop is at {ratio:.3g} times its stability bound, mostly of joint"
                f" {joint!r}, at the start pose"
            )
            if ratio >= 1:
                self._warn("unstable", f"{text}: {report.effect}", report.remedy)
            else:
                text = f"{text}: it may diverge in other poses"
                self._note("near-unstable", text, report.remedy)

    def _check_ringing(
        self,
        params: bp.PIDParams,
        start: Float64,
        timestep: float,
        env: int,
    ) -> None:
        slow = slow_oscillation(self.robot, params, start, timestep, env)
        zeta = float(slow.damping_ratio)
        if zeta >= RINGING:
            return
        rest = math.exp(-2 * math.pi * zeta / math.sqrt(1 - zeta**2))
        text = (
            f"the PID loop rings at {slow.frequency:.2g} Hz with a damping ratio of {zeta:.2g} at"
            f" the start pose: after each period {100 * rest:.0f} % of the amplitude remains"
        )
        joint = self.robot.joint_names[int(np.argmax(slow.participation))]
        report = self._note if zeta > 0 else self._warn
        remedy = "raise its kd, lower its ki, or use robot.designed()"
        report("ringing", text, remedy, joint)

    def check_params(self, params: bp.PIDParams, control: str) -> None:
        """Report params that disagree with the joints, or have no effect under ``control``."""
        wraps = np.zeros(self.robot.dof, bool)
        if params.continuous is not None:
            wraps |= np.asarray(params.continuous).any(axis=0)
        for index, joint in enumerate(self.robot.joints):
            if joint.continuous and not wraps[index] and control == "pid":
                text = "continuous in the URDF, not in params: the error jumps where qpos wraps"
                remedy = "pass continuous= to make_params, or use robot.params()"
                self._warn("continuous", text, remedy, joint.name)
            if wraps[index] and not joint.continuous:
                text = (
                    "continuous in params, not in the URDF: the short way round may exceed limits"
                )
                remedy = "leave it out of continuous="
                self._warn("continuous", text, remedy, joint.name)
