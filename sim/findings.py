"""Findings: oddities of a robot, repairs of its files, and causes for which a run does not settle.

:data:`FINDING_KINDS` lists every kind, and the tables in the guides are made from it.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Self

from batchpid.errors import RobotError, warn

LIMIT_TOLERANCE = 1e-6
"""Excess of a position over a joint limit that counts as rounding [rad or m]."""
SEVERITIES = ("warning", "note")  # probably an error; good to know


class FindingKind(NamedTuple):
    """Kind of findings, which its ``code`` names for programs."""

    code: str
    severity: str
    """One of :data:`SEVERITIES`."""
    when: str
    """What a file has; text of findings of the preflight and of a run."""
    done: str
    """What is simulated instead; remedy of findings of the preflight and of a run."""


OF_FILES = (
    FindingKind("xml", "warning",
         "text around the root, a wrong encoding, `--` in a comment, an undeclared prefix, elements of xacro",
         "the first `<robot>`; a default namespace (`xmlns=`) is ignored. `${...}` or `$(...)` in an attribute is an"
         " error: the file was never expanded"),
    FindingKind("unknown-element", "note",
         "elements and attributes that no URDF has, or that have no effect here",
         "without them"),
    FindingKind("repeated", "warning",
         "names used twice or missing; several `<limit>`, `<origin>`, `<inertial>`, ... of one element, or shapes of"
         " one `<geometry>`",
         "the first of them; joints get a name, and a robot is called after its file"),
    FindingKind("loose-link", "warning",
         "a link that joints name but nothing defines; a link that no joint names",
         "an empty link; without the link"),
    FindingKind("joint", "warning",
         "floating, planar and unknown joints; an axis without direction",
         "fixed joints, a floating one at the root a floating base; the x axis, the URDF's default"),
    FindingKind("limits", "warning",
         "limits that are swapped, missing, unreadable, or all 0; `effort` or `velocity` of 0 or -1; in an MJCF"
         " file effort limits that differ by direction, and limits of a servo's setpoints",
         "swapped back; no limit; the smaller limit; `guard=True` keeps to those of setpoints"),
    FindingKind("dynamics", "warning", "friction or damping that is negative or no number", "0"),
    FindingKind("mimic", "warning",
         "a mimic of a fixed or unknown joint, of itself, in a circle, or by 0",
         "an independent joint"),
    FindingKind("inertia", "warning",
         "an inertia tensor that no body has, or none; a mass that is no number",
         "the nearest possible tensor, or as given, see below; no mass"),
    FindingKind("collision", "warning",
         "shapes without geometry, extent or place; meshes of a URDF that are not convex",
         "without the shape; the convex hull of the mesh collides"),
    FindingKind("missing-mesh", "warning",
         "a mesh that is not there or cannot be read",
         "without the shape"),
    FindingKind("self-collision", "warning",
         "a pair in the .srdf that does not name two links of the robot",
         "without the pair"),
    FindingKind("actuator", "warning",
         "an MJCF actuator other than a motor or servo of one joint: of several joints, a muscle, with a filter or"
         " delay; a joint without actuator",
         "a motor for each joint"),
    FindingKind("option", "warning",
         "in an MJCF file other gravity, and bodies with `gravcomp`",
         "gravity of -9.81 m/s^2, without compensation"),
    FindingKind("engine", "warning",
         "content that an engine simulates otherwise than the file says: in SAPIEN closed loops, tendons, springs,"
         " nonlinear damping, `<flag>`s, a medium, bodies apart from the robot, height fields, planes other than a"
         " level one at height 0, wheels that are cylinders, and pairs of links beyond its filter",
         "as the finding says; MuJoCo simulates the file itself"),
)  # fmt: skip
"""Kinds of findings about a file."""
OF_ROBOTS = (
    FindingKind("units", "warning",
         "sizes or angles are not those of a robot: millimetres read as metres, or degrees as radians",
         "give metres and radians, meshes in millimetres with <mesh scale='0.001 0.001 0.001'>"),
    FindingKind("no-inertia", "warning",
         "no <inertial>: its collision shapes give mass and inertia; without shapes, or with a mass of 0, it weighs"
         " 1e-6 kg",
         "add <inertial> with mass and inertia: gains in efforts cannot control a link without mass"),
    FindingKind("out-of-limits", "warning",
         "the setpoint or the start pose is outside the joint limits",
         "move it inside"),
    FindingKind("touching", "warning",
         "links touch or overlap each other, or the ground",
         "choose another pose or path, correct the collision shapes, disable the pair in an .srdf, or use"
         " ground=False"),
    FindingKind("effort-limit", "warning",
         "the effort limit does not suffice for gravity and friction, or for the move in its time",
         "raise the effort limit, lighten the load, choose other poses, or give the move more time"),
    FindingKind("no-effort-limit", "note",
         "no effort limit: designed and tuned gains use limits from gravity and inertia",
         "give <limit effort=>, or pass effort_limit= to robot.params()"),
    FindingKind("unstable", "warning",
         "the gains are near the stability bound of the sampled PID loop, or beyond it",
         "lower the gains, or use robot.designed()"),
)  # fmt: skip
"""Kinds of findings about a robot, its gains and its setpoint."""
OF_RUNS = (
    FindingKind("failed", "warning",
         "an input was not finite, or the state diverged",
         "correct the input or lower the gains"),
    FindingKind("guard", "warning",
         "the guard holds the setpoint back",
         "move it inside the guard's limits, or give it more time"),
    FindingKind("oscillates", "warning",
         "oscillates: gains are beyond the stability bound, hardly damped, or too high for the delays",
         "use robot.designed(), or raise kd and lower kp and ki; robot.check(params=) tells which"),
    FindingKind("blocked", "warning",
         "something outside the robot's model acts on it: an object, a payload, another force",
         "look at the scene; for a constant load use gains with integral action"),
    FindingKind("gains", "warning",
         "rests away from the setpoint: the remaining error balances gravity or friction",
         "raise kp, ki or integral_limit, or compensate gravity and friction"),
    FindingKind("slow", "warning",
         "still moves at the end of the run: to its setpoint, or behind a moving one",
         "run longer, hold the last setpoint, pass setpoint_rate, or raise the gains"),
)  # fmt: skip
"""Kinds of findings about a run, besides those about a robot."""
FINDING_KINDS = {kind.code: kind for kind in (*OF_FILES, *OF_ROBOTS, *OF_RUNS)}
"""Every kind of finding, by its code."""


@dataclass(frozen=True)
class Finding:
    """Oddity of a joint, a link or the robot, and the remedy.

    ``code`` is one of :data:`FINDING_KINDS`. ``text`` and ``remedy`` are the same for all joints
    with one cause; ``detail`` has the figures of this joint or link. ``envs`` and ``time`` [s] belong to
    findings of a run (:meth:`batchpid.sim.Rollout.findings`): the envs that have it, the first one
    first, and when it began there.
    """

    code: str
    text: str
    remedy: str
    joint: str | None = None
    link: str | None = None
    detail: str = ""
    envs: tuple[int, ...] = ()
    time: float | None = None

    @classmethod
    def of(cls, code: str, **facts: Any) -> Self:
        """Return a finding of a kind, with its text and remedy unless others are among the
        ``facts``.
        """
        kind = FINDING_KINDS[code]
        return cls(code, **{"text": kind.when, "remedy": kind.done} | facts)

    @property
    def severity(self) -> str:
        """One of :data:`SEVERITIES`, that of the kind."""
        return FINDING_KINDS[self.code].severity

    @property
    def where(self) -> str:
        """``"joint 'x'"``, ``"link 'x'"`` or ``"robot"``."""
        return f"{self._kind} {self._name}".strip()

    def __str__(self) -> str:
        return summary([self])[0]

    @property
    def figures(self) -> str:
        """Detail, envs and time in words."""
        if len(self.envs) > 1:
            more = f" and {len(self.envs) - 1} more"
        else:
            more = ""
        env = f"env {self.envs[0]}{more}" if self.envs else ""
        time = "" if self.time is None else f"{self.time:.3g} s"
        return ", ".join(
            part for part in (self.detail, " at ".join(filter(None, (env, time)))) if part
        )

    @property
    def _kind(self) -> str:
        return "joint" if self.joint is not None else "robot" if self.link is None else "link"

    @property
    def _name(self) -> str:
        name = self.link if self.joint is None else self.joint
        if name is None:
            return ""
        return repr(name)


class Findings(list[Finding]):
    """List of findings with a representation for people: a line for each."""

    def __repr__(self) -> str:
        return "\n".join(map(str, self)) or "[]"


def summary(findings: Iterable[Finding]) -> list[str]:
    """Return one sentence for each cause, with all joints or links that have it, in the order of
    ``findings``.
    """
    # A dict keeps the order in which causes appear.
    causes: dict[tuple[str, ...], list[Finding]] = defaultdict(list)
    for finding in findings:
        causes[finding.severity, finding.code, finding._kind, finding.text, finding.remedy].append(
            finding
        )
    return [_sentence(same) for same in causes.values()]


def _sentence(same: Sequence[Finding]) -> str:
    """Return the sentence for findings that differ only in joint or link, and detail."""
    first = same[0]
    names = list(
        dict.fromkeys(
            f"{finding._name} ({finding.figures})".strip() if finding.figures else finding._name
            for finding in same
        )
    )
    if len(names) == 1:
        return (
            f"{first.severity}: {f'{first._kind} {names[0]}'.strip()}: {first.text}; {first.remedy}"
        )
    return (
        f"{first.severity}: {first.text}; {first.remedy}. {len(names)} {first._kind}s:"
        f" {', '.join(names)}"
    )


class RepairWarning(UserWarning):
    """A robot's file was read with repairs."""


def report(path: Path, repairs: Sequence[Finding], strict: bool) -> None:
    """Warn of the ``repairs`` of the file at ``path`` that change the motion; if ``strict``, raise
    a RobotError that lists them.
    """
    severe = [finding for finding in repairs if finding.severity == "warning"]
    if not severe:
        return
    count = "1 repair" if len(severe) == 1 else f"{len(severe)} repairs"
    if not strict:
        warn(f"{path}: {count}; robot.check() and batchpid inspect list them", RepairWarning)
        return
    sentences = [sentence.partition(": ")[2] for sentence in summary(severe)]
    listed = "".join(f"\n  {sentence}" for sentence in sentences)
    raise RobotError(f"{path}: needs {count}, which strict=True refuses:{listed}")


def report_shortfalls(path: Path, engine: str, shortfalls: Iterable[Finding]) -> None:
    """Warn of what an engine runs otherwise than the file at ``path`` says."""
    if count := len(list(shortfalls)):
        text = f"engine {engine!r} runs otherwise than the file says in {count} findings"
        warn(f"{path}: {text}; robot.check(engine={engine!r}) lists them", RepairWarning)
