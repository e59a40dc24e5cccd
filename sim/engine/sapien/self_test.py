"""Self-test of native calls into SAPIEN: sim steps, ticks and drives are compared with Python's, bit by bit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.elementwise import matrix_vector
from batchpid.native.array_program import ArrayProgram
from batchpid.native.tracing import trace
from batchpid.sim.engine.native import python_calls
from batchpid.sim.engine.native.native_tick import NativeTick
from batchpid.sim.engine.native_model import NativeModel
from batchpid.sim.engine.native_self_test import spec_of_two_joints
from batchpid.sim.engine.sapien.building import build_scene, new_system
from batchpid.sim.engine.sapien.built_tree import scene_tree
from batchpid.sim.engine.sapien.calls import PythonCalls
from batchpid.sim.engine.sapien.native_calls import NativeCalls
from batchpid.sim.engine.sapien.pack import Pack
from batchpid.sim.engine.sapien.physics import PHYSICS
from batchpid.sim.engine.scene_spec import SceneSpec

STEPS = 50


def main() -> None:
    """Raise an error if a result differs."""
    _compare_calls()
    _compare_steps()
    _compare_ticks()
    _compare_drives()


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
        return [matrix_vector(matrix, wanted)]

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
    return replace(spec_of_two_joints(), physics=PHYSICS["accurate"])


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
