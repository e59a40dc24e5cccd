"""Randomization for evaluation and search: presets, files, and payloads that the robot can carry."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

import batchpid.task_space as ts
from batchpid.arrays.array_types import Document
from batchpid.checks.validate import file_path
from batchpid.errors import InvalidArgumentError
from batchpid.io import documents
from batchpid.motors import DRIVEN
from batchpid.sim.randomization.checks import check_robot
from batchpid.sim.randomization.distributions import Uniform
from batchpid.sim.randomization.randomization import Randomization
from batchpid.sim.robot.robot import Robot

GRAVITY = 9.81
PAYLOAD_SHARE = 0.5
"""Share that a payload may take of the effort that the robot's own weight leaves."""
PAYLOAD = 0.5
"""Largest payload of the presets [kg]; less where the robot cannot carry it."""
PRESETS: dict[str, Document] = {
    "payload": {},
    "model": {
        "link_mass": Uniform(0.9, 1.1, operation="scale"),
        "friction": Uniform(0.5, 1.5, operation="scale", shared=True),
        "damping": Uniform(0.5, 1.5, operation="scale", shared=True),
    },
}
"""Fields of the presets, in addition to the payload."""


def load_randomization(name: str | Path, robot: Robot, seed: int = 0) -> Randomization:
    """Return a preset for ``robot``, or the randomization in a YAML or JSON file; without a seed there, with ``seed``.

    Raises
    ------
    InvalidArgumentError
        There is no such preset or file, or it does not fit the robot.
    """
    if name in PRESETS:
        payload = Uniform(0, min(PAYLOAD, payload_capacity(robot)))
        return Randomization(seed=seed, payload=payload, **PRESETS[str(name)])
    path = file_path("randomize", name)
    if path.suffix.lower() not in documents.SUFFIXES or not path.exists():
        raise InvalidArgumentError(
            "randomize",
            "is neither a preset nor a file",
            value=str(name),
            remedy=f"use a .yaml or .json file, or {' or '.join(PRESETS)}",
        )
    known = documents.read(path)
    with documents.named(str(path)):
        randomization = Randomization.from_dict({"seed": seed, **known} if isinstance(known, dict) else known)
        check_robot(randomization, robot)
    return randomization


def reseeded(randomization: Randomization | None, seed: int) -> Randomization | None:
    """Return ``randomization`` with ``seed`` added to its seed, for other draws."""
    return None if randomization is None else replace(randomization, seed=randomization.seed + seed)


def at_the_joints(randomization: Randomization | None) -> Randomization | None:
    """Return ``randomization`` with only the actuator fields that affect PhysX's drives: friction and inertia."""
    if randomization is None:
        return None
    fields = {name: each for name, each in randomization.actuators.items() if name in DRIVEN}
    return replace(randomization, actuators=fields)


def payload_capacity(robot: Robot) -> float:
    """Return the payload [kg] that the robot holds in 95 % of seeded poses with half of the effort it has left."""
    tree, qpos = robot.rigid_tree, robot.sample(200, seed=0)
    own = np.abs(robot.holding_efforts(qpos))
    per_kg = GRAVITY * np.abs(ts.jacobian(tree, qpos, tree.tool)[:, 2])
    with np.errstate(divide="ignore", invalid="ignore"):
        carried = np.where(per_kg > 1e-9, PAYLOAD_SHARE * (robot.design_effort_limit - own) / per_kg, np.inf)
    return float(max(np.quantile(carried.min(1), 0.05, method="lower"), 0.0))
