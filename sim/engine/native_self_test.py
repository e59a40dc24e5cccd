"""Self-test of the native extensions, in a separate process: a result that differs from Python's is a failure.

Calls into SAPIEN, sim steps, ticks and programs are compared bit by bit. The dynamics of many robots are compared with
NumPy's, which rounds differently, within a tolerance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.native.array_program import ArrayProgram
from batchpid.native.availability import first_difference
from batchpid.native.tracing import trace
from batchpid.sim.engine.batch_dynamics import (
    Friction,
    Loaded,
    MovingJoints,
    NativeBatchDynamics,
    NumpyBatchDynamics,
)
from batchpid.sim.engine.native import python_calls
from batchpid.sim.engine.native.native_tick import NativeTick
from batchpid.sim.engine.native_model import NativeModel
from batchpid.sim.engine.sapien.building import build_scene, new_system
from batchpid.sim.engine.sapien.built_tree import scene_tree
from batchpid.sim.engine.sapien.calls import PythonCalls
from batchpid.sim.engine.sapien.native_calls import NativeCalls
from batchpid.sim.engine.sapien.pack import Pack
from batchpid.sim.engine.sapien.physics import PHYSICS
from batchpid.sim.engine.scene_spec import SceneSpec
from batchpid.sim.robot.parts import Joint

STEPS = 50
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
    _compare_calls()
    _compare_steps()
    _compare_ticks()
    _compare_drives()
    _compare_dynamics()


def _compare_programs() -> None:
    """Compare programs of all operations with NumPy."""
    if problem := first_difference():
        raise AssertionError(problem)


def _compare_dynamics() -> None:
    """Compare the dynamics and a step of robots with payloads: with NumPy's, and with a call for each robot alone."""
    loaded = Loaded(scene_tree(replace(_spec(), ground=False)).held, 1, np.array([0.1, 0.0, 0.05]))
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


def _compare_steps() -> None:
    """Compare the native sim step with Python's, in two packs of robots that approach the ground."""
    ours = Pack(_spec(), 4)
    with python_calls():
        theirs = Pack(_spec(), 4)
    table, touched = np.zeros((3, 4, 2)), False
    for pack in (ours, theirs):
        pack.write_state(range(4), np.linspace((0, 0), (1.2, 0.4), 4), np.zeros((4, 2)))
    step = ours.compiled_step(True, True, True, None)
    for number in range(STEPS):
        effort = np.tile([20.0 * np.sin(number), 5.0], (4, 1))
        theirs.write_qf(effort)
        theirs.step()
        if step(effort, *table):
            raise AssertionError("a native sim step reports that a robot failed")
        reads = theirs.read_qpos(), theirs.read_qvel(), theirs.passive_force(True, True)
        if np.array(reads).tobytes() != table.tobytes():
            raise AssertionError("native and Python sim steps give different results")
        touched |= any(system.get_contacts() for system in ours.systems)
    if not touched:
        raise AssertionError("nothing was touched")


def _compare_ticks() -> None:
    """Compare a native tick with its program and its native sim steps, called from Python one after another."""
    every, shape = 3, (4, 2)
    target = np.linspace((0.2, 0.1), (0.8, 0.3), 4)

    def law(goal: Any, matrix: Any, qpos: Any, qvel: Any) -> list[Any]:
        wanted = 30.0 * (goal - qpos) - 5.0 * qvel
        return [(matrix * wanted[:, None, :]).sum(axis=-1)]

    model, armature = NativeModel(replace(_spec(), ground=False)), np.array([0.1, 0.2])
    tree, table = scene_tree(_spec()).tables
    results = []
    for in_ticks in (True, False):
        pack = Pack(_spec(), 4)
        qpos, qvel, passive, before, qf = np.zeros((5, *shape))
        matrix, done = np.zeros((4, 2, 2)), 0
        program = ArrayProgram(trace(law, 1, 3), [target], 3, shape)
        arrays: dict[str, Any] = {"qpos": qpos, "qvel": qvel, "passive": passive, "before": before, "qf": qf}
        own: dict[str, Any] = {"matrix": matrix, "tree": tree, "bodies": table, "armature": armature}
        inputs = (matrix, qpos, qvel)
        tick = NativeTick(program, inputs, (qf,), timestep=1e-2, matrix_steps=every, whole=True, **arrays, **own)
        step = pack.compiled_step(True, True, True, None)
        while done < STEPS:
            if in_ticks:
                done, status = tick.run(step.prepare(), done, STEPS, STEPS)
            else:
                if done % every == 0:
                    ahead = 0.5 * (min(every, STEPS - done) - 1) * 1e-2
                    matrix[...] = model.mass_matrix(qpos + ahead * qvel) + np.diag(armature)
                program(*inputs, out=(qf,))
                status, done = step(qf, qpos, qvel, passive), done + 1
            if status:
                raise AssertionError("a native tick reports that a robot failed")
        results.append([qpos, qvel, passive, qf, matrix])
    for ours, theirs in zip(*results, strict=True):
        if ours.tobytes() != theirs.tobytes():
            raise AssertionError("native ticks and their parts give different results")
    if not np.abs(results[0][0]).max() > 0.1:
        raise AssertionError("no robot moved in a native tick")


def _compare_drives() -> None:
    """Compare drives whose targets move within a native tick with targets that Python writes."""
    shape, results = (4, 2), []
    wanted = np.linspace((0.2, 0.1), (0.8, 0.3), 4)

    def law(goal: Any, qpos: Any) -> list[Any]:
        return [0.5 * (goal - qpos), qpos + 0.5 * (goal - qpos), 0.1 * (goal - qpos)]

    for in_ticks in (True, False):
        pack = Pack(_spec(), 4)
        pack.write_drive(np.array([400.0, 300.0]), np.array([40.0, 30.0]), np.array([np.inf, np.inf]))
        qpos, qvel, passive, before, qf, target, rate = np.zeros((7, *shape))
        program = ArrayProgram(trace(law, 1, 1), [wanted], 1, shape)
        outputs = qf, target, rate
        arrays: dict[str, Any] = {"qpos": qpos, "qvel": qvel, "passive": passive, "before": before, "qf": qf}
        moving: dict[str, Any] = {"target": target, "target_rate": rate}
        tick = NativeTick(program, (qpos,), outputs, timestep=1e-2, **arrays, **moving)
        step, done = pack.compiled_step(True, True, True, None, True), 0
        while done < STEPS:
            if in_ticks:
                done, status = tick.run(step.prepare(), done, STEPS, STEPS)
            else:
                program(qpos, out=outputs)
                pack.write_drive_target(target, rate)
                status, done = step(qf, qpos, qvel, passive), done + 1
            if status:
                raise AssertionError("a native tick reports that a robot failed")
        results.append([qpos, qvel, target])
    for ours, theirs in zip(*results, strict=True):
        if ours.tobytes() != theirs.tobytes():
            raise AssertionError("drives move otherwise in native ticks")
    if not np.abs(results[0][0]).max() > 0.1:
        raise AssertionError("no robot was driven")


def _compare_calls() -> None:
    reads = [_run(make) for make in (PythonCalls, NativeCalls)]
    for ours, theirs in zip(*reads, strict=True):
        if ours.tobytes() != theirs.tobytes():
            raise AssertionError("native and Python calls give different results")
    if not np.ptp(reads[0][-3], axis=0).any():
        raise AssertionError("no robot moved")


def _spec() -> SceneSpec:
    joints = (Joint("turn", "revolute", "base", "arm"), Joint("slide", "prismatic", "arm", "hand"))
    return SceneSpec(_URDF, (), joints, 1e-2, PHYSICS["accurate"])


def _run(make: Callable[..., Any]) -> list[NDArray[Any]]:
    """Return everything that is read in a run under varied efforts, which ends on the ground."""
    spec = _spec()
    systems = [new_system(spec) for _ in range(4)]
    scenes, robots = zip(*(build_scene(spec, system) for system in systems), strict=True)
    qf, skip = np.zeros((4, 2), np.float32), np.array([False, False, False, True])
    for row, robot in enumerate(robots):
        robot.set_qpos(np.array([0.2 * row, 0.1 * row], np.float32))
    calls, found = make(robots, systems, qf, skip), []
    for step in range(STEPS):
        qf[...] = calls.passive_force(True, True, np.float64) + np.array([[20.0 * np.sin(step), 5.0]])
        calls.write_qf()
        calls.step()
        found += [calls.qpos(np.float64), calls.qvel(np.float32), calls.passive_force(False, True, np.float32)]
    for scene in scenes:
        scene.clear()
    try:
        calls.qpos(np.float64)
    except RuntimeError:
        return found
    raise AssertionError("a robot whose scene is gone can still be read")
