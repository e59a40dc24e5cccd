"""Rows of a table of a robot's joints, for the terminal and for notebooks."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

from batchpid.sim.robot.parts import Joint

HEADERS = ("", "joint", "type", "limits", "effort", "velocity", "damping", "friction", "parent > child link")


def joint_rows(joints: Iterable[Joint]) -> Iterator[list[str]]:
    """Yield the cells of each joint under :data:`HEADERS`. Moving joints are numbered as in qpos."""
    index = 0
    for joint in joints:
        links = f"{joint.parent_link} > {joint.child_link}"
        if not joint.moves:
            yield ["-", joint.name, joint.type, *"-----", links]
            continue
        yield [
            str(index),
            joint.name,
            joint.type,
            _range(joint),
            _bound(joint.effort_limit, f" {joint.effort_unit}"),
            _bound(joint.velocity_limit, f" {joint.unit}/s"),
            f"{joint.damping:g}",
            f"{joint.friction:g}",
            links,
        ]
        index += 1


def _range(joint: Joint) -> str:
    limits = joint.lower, joint.upper
    return f"{_bound(limits[0])} to {_bound(limits[1])} {joint.unit}" if any(map(math.isfinite, limits)) else "none"


def _bound(value: float, unit: str = "") -> str:
    return f"{value:.5g}{unit}" if math.isfinite(value) else "none"
