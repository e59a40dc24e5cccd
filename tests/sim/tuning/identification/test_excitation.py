import numpy as np
import pytest

import batchpid as bp
from batchpid.sim.identification.excitation import excite, is_feasible
from batchpid.sim.identification.logs import setpoint_csv


@pytest.mark.parametrize("name", ["panda", "jaco2"])
def test_the_motion_keeps_the_limits_and_moves_every_joint(name, request):
    robot = request.getfixturevalue(name)
    motion = excite(robot, 4.0, rate=100)
    assert is_feasible(robot, motion)
    assert motion.ticks == 400
    assert (np.ptp(motion.position, axis=0) > [0.02 if unit == "rad" else 0.002 for unit in robot.units]).all()
    np.testing.assert_allclose(motion.position[[0, -1]], motion.position[[0, 0]], atol=1e-4)
    assert (np.abs(motion.velocity[[0, -1]]) < 0.05).all()
    assert np.linalg.cond(np.corrcoef(motion.velocity[:, robot.independent].T)) < 100  # all motions differ


def test_the_seed_decides(panda):
    first, again, other = (excite(panda, 2.0, rate=50, seed=seed) for seed in (1, 1, 2))
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert not np.array_equal(first.position, other.position)


def test_the_file_reads_back_as_the_motion(panda):
    motion = excite(panda, 1.0, rate=50)
    header, *rows = setpoint_csv(panda, motion).splitlines()
    assert header.split(",") == ["time", *(f"setpoint:{name}" for name in panda.joint_names)]
    table = np.array([[float(cell) for cell in row.split(",")] for row in rows])
    np.testing.assert_allclose(table[:, 1:], motion.position, atol=1e-8)
    assert table[0, 0] == 0


@pytest.mark.parametrize(("name", "value"), [("duration", 0), ("rate", 1), ("highest", 0.01), ("seed", -1)])
def test_options_out_of_range_are_refused(panda, name, value):
    with pytest.raises(bp.InvalidArgumentError, match=name):
        excite(panda, **{name: value})
