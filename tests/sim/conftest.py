"""Fixtures shared by the tests of sim."""

from __future__ import annotations

import pytest
from robots import load_bundled

from batchpid.sim import Robot


@pytest.fixture(scope="session")
def panda() -> Robot:
    """The bundled panda: 7 joints and 2 fingers."""
    return load_bundled("panda")


@pytest.fixture(scope="session")
def jaco2() -> Robot:
    """The bundled jaco2: 7 joints, 3 fingers and 3 finger tips, all revolute."""
    return load_bundled("jaco2")
