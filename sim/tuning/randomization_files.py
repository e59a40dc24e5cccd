"""Randomization for evaluation and search: read from files, and with other seeds."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from batchpid.checks.validate import file_path
from batchpid.io import documents
from batchpid.motors import DRIVEN
from batchpid.sim.randomization.checks import check_robot
from batchpid.sim.randomization.randomization import Randomization
from batchpid.sim.robot.robot import Robot


def load_randomization(path: str | Path, robot: Robot, seed: int = 0) -> Randomization:
    """Return the randomization in a YAML or JSON file, with ``seed`` unless the file gives one.

    Raises
    ------
    OSError
        The file cannot be read.
    InvalidArgumentError
        It is not a randomization, or does not fit the robot.
    """
    path = file_path("randomize", path)
    document = documents.read(path)
    with documents.named(str(path)):
        randomization = Randomization.from_dict(
            {"seed": seed, **document} if isinstance(document, dict) else document
        )
        check_robot(randomization, robot)
    return randomization


def reseeded(randomization: Randomization | None, seed: int) -> Randomization | None:
    """Return ``randomization`` with ``seed`` added to its seed, for other draws."""
    if randomization is None:
        return None
    return replace(randomization, seed=randomization.seed + seed)


def at_the_joints(randomization: Randomization | None) -> Randomization | None:
    """Return ``randomization`` with only the actuator fields that affect PhysX's drives: friction
    and inertia.
    """
    if randomization is None:
        return None
    fields = {
        name: distribution
        for name, distribution in randomization.actuators.items()
        if name in DRIVEN
    }
    return replace(randomization, actuators=fields)
