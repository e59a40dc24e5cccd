"""Rows and masks that select no env change nothing, in both engines."""

import numpy as np
import pytest
from identical import assert_identical

from batchpid.sim import Randomization, Robot, Runner, Uniform

NONE = np.zeros(5, bool)
DRAWN = Randomization(
    payload=Uniform(0, 0.5),
    link_mass=Uniform(0.9, 1.1, operation="scale"),
    push=Uniform(0, 0.1),
    push_interval=Uniform(1, 2),
)


@pytest.fixture(params=["sapien", "mujoco"])
def engine(request):
    return request.param


@pytest.mark.parametrize(("workers", "floats"), [(0, False), (2, True)])
def test_a_mask_of_no_env(engine, workers, floats):
    robot = Robot.load("quadruped", fixed_base=not floats)
    options = {
        "randomization": DRAWN if floats else None,
        "contacts": [robot.tables.bodies[-1].name],
    }
    with Runner(robot, 5, engine=engine, workers=workers, **options) as runner:
        runner.step(robot.start)
        before = runner.observe()
        assert_identical(before, runner.reset(mask=NONE))
        assert_identical(before, runner.reset(qpos=robot.start + 0.1, mask=NONE))
        assert runner.reset(mask=np.arange(5) == 0).ok.all()  # a worker and a group with none
