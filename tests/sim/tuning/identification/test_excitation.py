import numpy as np
import pytest

import batchpid as bp
from batchpid.sim.identification.excitation import excite, is_feasible
from batchpid.sim.identification.logs import read_logs
from batchpid.sim.identification.setpoint_files import read_setpoints, setpoint_csv


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


def test_the_file_reads_back_as_the_motion(panda, tmp_path):
    motion = excite(panda, 1.0, rate=50)
    text = setpoint_csv(panda, motion)
    names = [f"{quantity}:{name}" for quantity in ("setpoint", "setpoint_rate") for name in panda.joint_names]
    assert text.splitlines()[0].split(",") == ["time", *names]
    path = tmp_path / "motion.csv"
    path.write_text(text)
    found = read_setpoints(panda, path, 1 / 2000)
    assert (found.substeps, found.has_rates, len(found.position)) == (40, True, 49)
    np.testing.assert_allclose(np.vstack([found.start, found.position]), motion.position, atol=1e-8)
    np.testing.assert_allclose(found.rate, motion.velocity[1:], atol=1e-8)


def test_a_log_may_keep_the_rates_of_the_setpoints(panda, tmp_path):
    motion = excite(panda, 1.0, rate=100)
    header, *rows = setpoint_csv(panda, motion).splitlines()
    header += "".join(f",qpos:{name}" for name in panda.joint_names)
    rows = [row + "".join(f",{value:.9g}" for value in pose) for row, pose in zip(rows, motion.position, strict=True)]
    (tmp_path / "log.csv").write_text("\n".join([header, *rows]))
    (log,) = read_logs(panda, [tmp_path / "log.csv"])
    assert log.kind == "setpoint"
    np.testing.assert_allclose(log.command, motion.position[:, list(log.joints)], atol=1e-8)


@pytest.mark.parametrize(("name", "value"), [("duration", 0), ("rate", 1), ("highest", 0.01), ("seed", -1)])
def test_options_out_of_range_are_refused(panda, name, value):
    with pytest.raises(bp.InvalidArgumentError, match=name):
        excite(panda, **{name: value})
