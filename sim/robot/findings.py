"""Findings: oddities of a robot and repairs of its files, each with the remedy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lxml import etree

from batchpid.errors import RobotError

MOST_LISTED = 50  # repairs in an error
SEVERITIES = ("warning", "note")  # probably not what is meant; good to know


@dataclass(frozen=True)
class Finding:
    """Oddity of a joint, a link or the robot, and the remedy.

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


def finding_of(element: etree._Element, severity: str, code: str, text: str, remedy: str) -> Finding:
    """Return a finding of the joint or link that an XML ``element`` is or belongs to, or of the robot."""
    owner: etree._Element | None = element
    while owner is not None and owner.tag not in ("joint", "link"):
        owner = owner.getparent()
    joint, link = (None if owner is None or owner.tag != tag else owner.get("name") for tag in ("joint", "link"))
    return Finding(severity, code, text, remedy, joint, link)


def refuse(path: Path, repairs: Sequence[Finding]) -> None:
    """Raise a RobotError that lists the ``repairs`` of the URDF at ``path``, if there are any."""
    if repairs:
        listed = "".join(f"\n  {each.where}: {each.text}; {each.remedy}" for each in repairs[:MOST_LISTED])
        listed += "\n  ..." if len(repairs) > MOST_LISTED else ""
        count = "1 repair" if len(repairs) == 1 else f"{len(repairs)} repairs"
        raise RobotError(f"{path}: needs {count}, which strict=True refuses:{listed}")
