"""Self-test of the native extensions, in a separate process: a result that differs from Python's is a failure.

Programs, and calls into SAPIEN where it is installed, are compared bit by bit. The dynamics of many robots are compared
with NumPy's, which rounds differently, within a tolerance.
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec

import numpy as np

from batchpid.native.availability import first_difference
from batchpid.sim.engine.batch_dynamics import Friction, Loaded, MovingJoints, NativeBatchDynamics, NumpyBatchDynamics
from batchpid.sim.engine.robot_model import description_tree
from batchpid.sim.engine.scene_spec import SceneSpec
from batchpid.sim.robot.parts import Joint

_BODY = """<inertial><mass value="1.5"/>
<inertia ixx="0.02" ixy="0.001" ixz="0" iyy="0.03" iyz="0" izz="0.01"/></inertial>
<collision><geometry><box size="0.1 0.1 0.4"/></geometry></collision>"""
_URDF = f"""<robot name="test"><link name="base"/><link name="arm">{_BODY}</link><link name="hand">{_BODY}</link>
<joint name="turn" type="revolute"><parent link="base"/><child link="arm"/><origin xyz="0 0 0.25"/><axis xyz="0 1 0"/>
<limit lower="-3" upper="3" effort="100" velocity="9"/></joint>
<joint name="slide" type="prismatic"><parent link="arm"/><child link="hand"/><origin xyz="0 0 0.5"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" effort="100" velocity="9"/></joint></robot>"""


def main() -> None:
    """Compare the results of the extensions with Python's; raise an error if they differ.

    This process uses the extensions without a test, since their fingerprint is in its environment.
    """
    _compare_programs()
    _compare_dynamics()
    if find_spec("sapien"):
        import_module("batchpid.sim.engine.sapien.self_test").main()


def _compare_programs() -> None:
    """Compare programs of all operations with NumPy."""
    if problem := first_difference():
        raise AssertionError(problem)


def _compare_dynamics() -> None:
    """Compare the dynamics and a step of robots with payloads: with NumPy's, and with a call for each robot alone."""
    loaded = Loaded(description_tree(spec_of_two_joints()).held, 1, np.array([0.1, 0.0, 0.05]))
    limit = np.array([np.inf, 1.0])
    joints = MovingJoints(np.array([0, 1], np.int32), np.ones(2), np.zeros(2), -limit, limit)
    rng, count = np.random.default_rng(0), 6
    qpos, qvel, effort = rng.uniform(-0.9, 0.9, (3, count, 2))
    payload, added = np.linspace(0.0, 2.0, count)[:, None], np.full((count, 2), 0.1)
    friction = Friction(np.full((count, 2), 0.3), np.full((count, 1), 0.01), np.full((count, 2), 0.02))
    results = []
    ours = NativeBatchDynamics(loaded, joints)
    for model, groups in (
        (ours, [slice(0, count)]),
        (ours, [slice(row, row + 1) for row in range(count)]),
        (NumpyBatchDynamics(loaded, joints), [slice(0, count)]),
    ):
        parts = []
        for rows in groups:
            found = model.at(qpos[rows], qvel[rows], payload[rows])
            state = (qpos[rows], qvel[rows], np.zeros_like(qpos[rows]))
            friction_rows = Friction(*(leaf[rows] for leaf in friction))
            step = model.step(state, found.matrix, effort[rows], added[rows], friction_rows, 1e-2)
            parts.append([*found, *step])
        results.append([np.concatenate(leaves) for leaves in zip(*parts, strict=True)])
    for mine, alone, theirs in zip(*results, strict=True):
        if mine.tobytes() != alone.tobytes():
            raise AssertionError("the native dynamics of a robot depend on the others")
        if not np.allclose(mine, theirs, rtol=1e-9, atol=1e-9):
            raise AssertionError("native dynamics and NumPy's give different results")


def spec_of_two_joints() -> SceneSpec:
    """Return an arm of two joints, without the settings of a solver."""
    joints = (Joint("turn", "revolute", "base", "arm"), Joint("slide", "prismatic", "arm", "hand"))
    return SceneSpec(_URDF, (), joints, 1e-2, None)
