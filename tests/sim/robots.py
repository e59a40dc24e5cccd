"""Bundled robots by name, for tests that are parametrized by name; the fixtures panda and jaco2 are these objects."""

from __future__ import annotations

import functools

from sim import Robot


@functools.cache
def load_bundled(name: str) -> Robot:
    """Return the bundled robot of that name, loaded once per process."""
    return Robot.load(name)
