"""Rows and masks that select no env change nothing, in both engines."""

from __future__ import annotations

import numpy as np
import pytest
from identical import assert_identical

from batchpid.sim import Randomization, Robot, Runner, Uniform
from batchpid.sim.engine.protocol import load_engine
from batchpid.sim.engine.scene_spec import SceneSpec, Variation

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


@pytest.mark.parametrize("workers", [0, 2])
@pytest.mark.parametrize("floats", [False, True])
def test_a_mask_of_no_env(engine, workers, floats):
    robot = Robot.load("quadruped", fixed_base=not floats)
    options = {"randomization": DRAWN if floats else None, "contacts": [robot.links[-1].name]}
    with Runner(robot, 5, engine=engine, workers=workers, **options) as runner:
        runner.step(robot.start)
        before = runner.observe()
        assert_identical(before, runner.reset(mask=NONE))
        assert_identical(before, runner.reset(qpos=robot.start + 0.1, mask=NONE))
        assert runner.reset(mask=np.arange(5) == 0).ok.all()  # a worker and a group with none


@pytest.mark.parametrize("floats", [False, True])
def test_rows_of_no_env(engine, floats):
    robot = Robot.load("quadruped", fixed_base=not floats)
    engine = load_engine(engine)
    spec = SceneSpec(
        robot.tables,
        (),
        robot.joints,
        1e-3,
        engine.physics["accurate"],
        fixed_base=not floats,
        engine=engine.name,
    )
    varied = Variation(payload=np.full(2, 0.3), ground_friction=np.full(2, 0.7))
    pack = engine.make_pack(spec, 2, variation=varied, carrier=robot.links[-1].name)
    pack.step()
    before, none, rows = pack.read_state(), np.zeros(0, np.intp), np.zeros((0, robot.dof))
    base = np.zeros((0, 13))
    pack.write_state(none, rows, rows, base if floats else None)
    pack.write_joints(None, none)
    pack.update_constraint(none)
    pack.vary(none, Variation(payload=np.zeros(0), ground_friction=np.zeros(0)))
    if floats:
        pack.push(none, base[:, :6])
    np.testing.assert_array_equal(before, pack.read_state())
    pack.close()
