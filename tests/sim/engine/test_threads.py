"""Objects that robots share, in caches, may be used by several threads."""

from __future__ import annotations

import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from batchpid.sim.engine.physics import PHYSICS
from batchpid.sim.engine.protocol import SceneSpec
from batchpid.sim.engine.sapien.building import build_scene, new_system


@pytest.fixture
def many_switches():
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before)


def in_threads(work, tasks: list) -> list:
    with ThreadPoolExecutor(len(tasks)) as executor:
        return [done for done in executor.map(work, tasks)]


def test_dynamics_give_every_thread_its_own_results(panda, many_switches):
    dynamics, poses = panda.dynamics(), panda.sample(80)

    def figures(qpos):
        heights = [dynamics.height(pose) for pose in qpos]
        return dynamics.in_contact(qpos), dynamics.mass_matrix(qpos), np.array(heights)

    parts = np.array_split(poses, 4)
    for alone, shared in zip(map(figures, parts), in_threads(figures, parts), strict=True):
        for one, other in zip(alone, shared, strict=True):
            assert np.array_equal(one, other)


def test_scenes_are_built_with_their_own_settings_in_every_thread(panda, many_switches):
    like = SceneSpec(panda.urdf, panda.ignored_pairs, panda.joints, 1e-3, PHYSICS["fast"], ground=False)
    specs = [replace(like, physics=replace(like.physics, position_iterations=count)) for count in (1, 2, 1, 2)]

    def built(spec: SceneSpec) -> set[int]:
        return {build_scene(spec, new_system(spec))[1].solver_position_iterations for _ in range(10)}

    assert in_threads(built, specs) == [{1}, {2}, {1}, {2}]
