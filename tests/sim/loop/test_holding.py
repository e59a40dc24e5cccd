"""Robots at rest, with the friction and damping of the URDF: efforts alone hold them in their
pose.
"""

import numpy as np
import pytest

from batchpid.sim import Runner

POSE = np.array([0.3, 0.4, -0.2, -1.8, 0.5, 1.9, 0.7, 0.02, 0.02])


def drift(runner, seconds=3.0):
    runner.reset(POSE)
    far = 0.0
    for _ in range(round(seconds * 100)):
        obs = runner.step(np.zeros(9) if runner.control == "effort" else POSE)
        far = max(far, np.abs(obs.qpos - POSE).max())
    return far


@pytest.mark.slow
def test_passive_force_alone_holds_the_pose(panda):
    with Runner(panda, 1, control="effort", workers=0) as runner:
        assert drift(runner) < 1e-3


def test_pid_holds_the_pose(panda):
    with Runner(panda, 1, params=panda.params(), workers=0) as runner:
        assert drift(runner) < 1e-5


def test_without_compensation_the_robot_falls(panda):
    with Runner(panda, 1, control="effort", compensate="none", workers=0) as runner:
        assert drift(runner, 0.5) > 0.1
