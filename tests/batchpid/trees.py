"""Kinematic trees for tests: bundled robots, random trees, and a planar arm of two links."""

import functools
import tempfile
from pathlib import Path

import numpy as np
from robots import load_bundled
from tiny_urdf import random_tree, robot, write

from batchpid.sim import Robot
from batchpid.task_space import RigidTree

NAMES = ["panda", "jaco2", 0, 1, 2]
"""Bundled robots, and seeds of random trees with branches, fixed and prismatic joints."""


@functools.cache
def robot_of(name):
    if isinstance(name, str):
        return load_bundled(name)
    folder = Path(tempfile.mkdtemp())  # kept, since an export reads the file again
    return Robot.load(write(folder, robot(*random_tree(np.random.default_rng(name), 12))))


@functools.cache
def tree_of(name):
    return robot_of(name).kinematic_tree()


def tool_of(name):
    """Return a link at the end of the longest chain of joints."""
    tree = tree_of(name)
    return (
        max(tree.links, key=lambda link: tree.chain(link).sum())
        if isinstance(name, int)
        else TOOLS[name]
    )


TOOLS = {"panda": "panda_hand", "jaco2": "j2s7s300_link_7"}


def states(tree, rows, seed=0):
    rng = np.random.default_rng(seed)
    low, high = np.maximum(tree.lower, -2.5), np.minimum(tree.upper, 2.5)
    return rng.uniform(low, high, (rows, tree.dof)), rng.normal(size=(rows, tree.dof))


def planar(lengths=(1.0, 1.0), gravity=(0.0, 0.0, 0.0)):
    """Return an arm in the plane: links along x with their mass of 1 kg in the middle, joints about
    z.
    """
    count = len(lengths) + 2
    at = np.zeros((count, 3))
    at[2:, 0] = lengths
    mass, center = np.array([0.0, *(1.0 for _ in lengths), 0.0]), np.zeros((count, 3))
    center[1:-1, 0] = np.array(lengths) / 2
    inertia = np.zeros((count, 3, 3))
    inertia[1:-1, 2, 2] = np.array(lengths) ** 2 / 12
    return RigidTree(
        links=("base", *(f"link{n}" for n in range(1, count - 1)), "tip"),
        parent=np.arange(-1, count - 1),
        joint_types=("fixed", *("revolute" for _ in lengths), "fixed"),
        joint_names=tuple(f"joint{n}" for n in range(1, count - 1)),
        position=at,
        wxyz=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        axis=np.tile([0.0, 0.0, 1.0], (count, 1)),
        mass=mass,
        center=center,
        inertia=inertia,
        gravity=gravity,
    )
