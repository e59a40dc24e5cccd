"""Fixtures shared by the tests of sim."""

import pytest
from robots import load_bundled

from batchpid.sim import RunnerOptions
from batchpid.sim.engine.protocol import load_engine


@pytest.fixture(params=["sapien", "mujoco"])
def engine(request, monkeypatch):
    """Engine of the runners that this test makes without naming one.

    In MuJoCo they have small groups in this process, which share their working memory.
    """
    name = request.param
    if name == "mujoco":
        monkeypatch.setattr(load_engine("mujoco"), "group_size", 4)
    original = RunnerOptions.__init__

    def init(options, *args, **given):
        original(options, *args, **{"engine": name, **given})

    monkeypatch.setattr(RunnerOptions, "__init__", init)
    return name


@pytest.fixture
def needs_jax():
    """Skip a test of Runners with backend "jax" where JAX is missing."""
    pytest.importorskip("jax")


@pytest.fixture
def small_groups(monkeypatch):
    """Give runners in this process several groups of envs."""
    for name in ("sapien", "mujoco"):
        monkeypatch.setattr(load_engine(name), "group_size", 4)


@pytest.fixture(scope="session")
def panda():
    """The bundled panda: 7 joints and 2 fingers."""
    return load_bundled("panda")


@pytest.fixture(scope="session")
def jaco2():
    """The bundled jaco2: 7 joints, 3 fingers and 3 finger tips, all revolute."""
    return load_bundled("jaco2")
