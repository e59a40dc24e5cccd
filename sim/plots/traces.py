"""What there is to draw of a run: its courses over time, and the joints they belong to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.errors import InvalidArgumentError


@dataclass(frozen=True, eq=False)
class Traces:
    """What there is to draw of a run. Limits that a joint does not have are infinite.

    Not-finite samples are gaps; so is everything of an env from where ``ok`` is False.
    """

    time: NDArray[Any]
    """(ticks,) [s]."""
    setpoint: NDArray[Any]
    """(ticks, envs, joints) [rad or m]."""
    qpos: NDArray[Any]
    """(ticks, envs, joints) [rad or m]."""
    effort: NDArray[Any]
    """(ticks, envs, joints) [N m or N]."""
    saturated: NDArray[Any]
    """(ticks, envs, joints) bool."""
    joint_names: tuple[str, ...]
    units: tuple[str, ...]
    """Of each joint's position: "rad" or "m"."""
    lower: NDArray[Any]
    """(joints,) [rad or m]."""
    upper: NDArray[Any]
    """(joints,) [rad or m]."""
    effort_limit: NDArray[Any]
    """(joints,) [N m or N]."""
    label: str = ""

    @classmethod
    def of(cls, rollout: Any, robot: Any, label: str = "") -> Traces:
        """Traces of a ``sim.Rollout`` of a ``sim.Robot``, or of what a file says of one: see ``sim.dataset``."""
        alive = np.asarray(rollout.ok)[..., None]
        return cls(
            time=np.asarray(rollout.time),
            setpoint=np.asarray(rollout.setpoint),
            qpos=np.where(alive, rollout.qpos, np.nan),
            effort=np.where(alive, rollout.effort, np.nan),
            saturated=np.asarray(rollout.saturated),
            joint_names=tuple(robot.joint_names),
            units=tuple(robot.units),
            lower=np.asarray(robot.lower),
            upper=np.asarray(robot.upper),
            effort_limit=np.asarray(robot.effort_limit),
            label=label,
        )

    @property
    def num_envs(self) -> int:
        """Number of envs."""
        return int(self.qpos.shape[1])

    def effort_unit(self, joint: int) -> str:
        """Unit of a joint's effort."""
        return "N" if self.units[joint] == "m" else "N m"

    def chosen(self, joints: Sequence[int | str] | None) -> list[int]:
        """Indices of ``joints`` given by index or name; None: all."""
        if joints is None:
            return list(range(len(self.joint_names)))
        known: dict[int | str, int] = {name: index for index, name in enumerate(self.joint_names)}
        known |= {index: index for index in range(len(self.joint_names))}
        for joint in joints:
            if joint not in known:
                raise InvalidArgumentError(
                    "joints", "no such joint", value=joint, remedy=f"use {', '.join(self.joint_names)}"
                )
        return [known[joint] for joint in joints]
