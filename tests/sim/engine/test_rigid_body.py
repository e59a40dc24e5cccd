"""The mass matrix in JAX programs equals Pinocchio's, for any tree of joints."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
from robots import load_bundled
from tiny_urdf import random_tree, robot, write

from batchpid.sim import Robot
from batchpid.sim.engine.native import xla

jax = pytest.importorskip("jax")
pytestmark = pytest.mark.skipif(not xla.status().active, reason="there are no native calls")


def load(name, folder):
    """Return a bundled robot, or for a number one of twelve links, with fixed joints, merged for even numbers."""
    if isinstance(name, str):
        return load_bundled(name)
    path = write(folder, robot(*random_tree(np.random.default_rng(name), 12)))
    return Robot.load(path, merge_fixed=name % 2 == 0)


def mass_matrices(arm, qpos, dtype=np.float64):
    dynamics = arm.dynamics()
    with jax.enable_x64(dtype == np.float64):
        return np.asarray(jax.jit(dynamics.mass_matrix)(jax.numpy.asarray(qpos, dtype)))


@pytest.mark.parametrize("name", ["panda", "jaco2", 0, 1])
def test_it_is_pinocchios(name, tmp_path):
    arm = load(name, tmp_path)
    qpos = np.random.default_rng(0).uniform(np.maximum(arm.lower, -3), np.minimum(arm.upper, 3), (40, arm.dof))
    expected = arm.dynamics().mass_matrix(qpos)
    inertia = np.sqrt(np.einsum("ejj->ej", expected))
    scale = inertia[:, :, None] * inertia[:, None, :]
    np.testing.assert_allclose(mass_matrices(arm, qpos) / scale, expected / scale, rtol=0, atol=1e-9)
    np.testing.assert_allclose(mass_matrices(arm, qpos, np.float32) / scale, expected / scale, rtol=0, atol=1e-3)


def test_a_row_does_not_depend_on_the_others(panda):
    qpos = np.random.default_rng(0).uniform(-1, 1, (16, panda.dof))
    whole = mass_matrices(panda, qpos)
    np.testing.assert_array_equal(mass_matrices(panda, qpos[5:8]), whole[5:8])
    with jax.enable_x64(True):
        each = jax.vmap(panda.dynamics().mass_matrix)(jax.numpy.asarray(qpos))
    np.testing.assert_array_equal(each, whole)


FIRST_CALL = """
import sys
import jax.numpy as jnp
from batchpid.sim import Robot
from batchpid.sim.engine import native

robot = Robot.load("panda")
if sys.argv[1:]:
    with native.python_calls():
        robot.dynamics().mass_matrix(jnp.zeros((2, robot.dof)))
print(robot.dynamics().mass_matrix(jnp.zeros((2, robot.dof))).shape)
"""


def test_it_is_there_before_any_runner():
    def run(*arguments):
        command = [sys.executable, "-c", FIRST_CALL, *arguments]
        return subprocess.run(command, env=os.environ, capture_output=True, text=True, timeout=120)

    assert run().stdout == "(2, 9, 9)\n"
    assert "batchpid.errors.InvalidArgumentError: qpos: is an array of JAX" in run("python").stderr
