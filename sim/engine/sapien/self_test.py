"""Self-test of native calls into SAPIEN: sim steps, ticks and drives are compared with Python's, bit by bit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.sim.engine.native import python_calls
from batchpid.sim.engine.native_self_test import spec_of_two_joints
from batchpid.sim.engine.sapien.building import build_scene, new_system
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
