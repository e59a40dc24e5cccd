"""Findings: oddities of a robot and repairs of its files, each with the remedy."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from batchpid.errors import RobotError, warn

SEVERITIES = ("warning", "note")  # probably an error; good to know


@dataclass(frozen=True)
class Finding:
    """Oddity of a joint, a link or the robot, and the remedy.

    ``severity`` is one of :data:`SEVERITIES`; ``code`` names the kind of finding, for programs.
    ``text`` and ``remedy`` are the same for all joints with one cause; ``detail`` has the figures
    of this joint or link. ``envs`` and ``time`` [s] belong to findings of a run
    (:meth:`batchpid.sim.Rollout.findings`): the envs that have it, the first one first, and when it
    began there.
    """

    severity: str
    code: str
    text: str
    remedy: str
    joint: str | None = None
    link: str | None = None
    detail: str = ""
    envs: tuple[int, ...] = ()
    time: float | None = None

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
            f"{finding._name} ({finding.figures})" if finding.figures else finding._name
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


class Notes(NamedTuple):
    """Findings of a file that is read: ``repairs`` are what is simulated otherwise than the file
    says, ``losses`` what is lost where MuJoCo does not simulate an MJCF file itself.
    """

    repairs: list[Finding]
    losses: list[Finding]

    def lose(
        self,
        code: str,
        text: str,
        joint: str | None = None,
        link: str | None = None,
        severity: str = "warning",
    ) -> None:
        """Add a loss."""
        remedy = "use the engine 'mujoco', which simulates the file itself"
        self.losses.append(Finding(severity, code, text, remedy, joint, link))


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
    count = sum(finding.severity == "warning" for finding in shortfalls)
    if count:
        text = f"engine {engine!r} runs otherwise than the file says in {count} findings"
        warn(f"{path}: {text}; robot.check(engine={engine!r}) lists them", RepairWarning)
