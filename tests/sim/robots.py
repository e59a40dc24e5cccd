"""Bundled robots by name, for tests that are parametrized by name; the fixtures panda and jaco2 are
these objects.
"""

import dataclasses
import functools
import sysconfig
from pathlib import Path

import pytest

from batchpid.sim import Robot

RUBBING = "panda with friction"


@functools.cache
def load_bundled(name):
    """Return the bundled robot of that name, loaded once per process; RUBBING is a panda with
    friction and damping.
    """
    if name != RUBBING:
        return Robot.load(name)
    panda = Robot.load("panda")
    rows = zip(panda.joints, (0.5, 0.0, 0.2, 0.1, 0.3, 0.1, 0.05, 0.5, 0.0), strict=True)
    joints = tuple(
        dataclasses.replace(joint, friction=friction, damping=2 * friction)
        for joint, friction in rows
    )
    return dataclasses.replace(panda, joints=joints)


PUBLISHED = Path(sysconfig.get_path("purelib")) / "cmeel.prefix/share/example-robot-data/robots"


def load_published(name):
    """Return a bundled robot, or one of the package example-robot-data without joint friction:
    these files give a torque, PhysX takes a dimensionless coefficient.
    """
    if not name.endswith(".urdf"):
        return load_bundled(name)
    if not (PUBLISHED / name).is_file():
        pytest.skip("example-robot-data is not installed")
    robot = Robot.load(PUBLISHED / name)
    joints = tuple(dataclasses.replace(joint, friction=0.0) for joint in robot.joints)
    return dataclasses.replace(robot, joints=joints)
