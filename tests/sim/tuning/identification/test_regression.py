import numpy as np
import pytest

from batchpid.sim.identification.logged_control import LoggedDrive
from batchpid.sim.identification.logs import Log
from batchpid.sim.identification.plant import Plant, Segment
from batchpid.sim.identification.regression import STRONG, Regression, smooth
from batchpid.sim.identification.unknowns import KINDS, Motors

pytest.importorskip("scipy")
DT = 1 / 2000


def log_of(qpos: np.ndarray, command: np.ndarray, every: int) -> Log:
    time = DT * np.arange(0, len(qpos), every)
    return Log("log", tuple(range(qpos.shape[1])), "setpoint", time, qpos[::every], time, command[::every], False)


def motors_of(**values: list[float]) -> Motors:
    return {kind: np.atleast_2d(values[kind]) for kind in KINDS}


@pytest.mark.slow
def test_joints_that_stick_half_of_the_time_are_found(panda):
    joints, params = (5,), panda.designed("effort")
    params = type(params)(*(leaf[:, list(joints)] if getattr(leaf, "ndim", 0) == 2 else leaf for leaf in params))
    plant = Plant(panda, joints, LoggedDrive(DT, params, "gravity+coriolis"))
    sticky = motors_of(
        armature=[0.05], damping=[0.2], friction=[1.0], strength=[1.0], bias=[0.1],
        delay=0.002, stopping=0.002, payload=0.0,
    )  # fmt: skip
    time = DT * np.arange(8000)
    waves = (np.sin(5 * time) ** 3 + 0.3 * np.sin(21 * time) ** 5)[:, None]
    setpoints = panda.start[list(joints)] + 0.2 * waves
    qpos = plant.simulate(sticky, [Segment(setpoints[0], np.zeros(1), setpoints, np.zeros_like(setpoints))], 0)[0, :-1]
    log = log_of(qpos, setpoints, 1)
    motion = smooth(log, DT)
    assert (np.abs(motion.qvel) < 1e-3).mean() > 0.2
    found = Regression(plant, [log], [motion], False).at(0.002, 0.0, STRONG).motors
    for kind in ("armature", "friction", "strength"):
        np.testing.assert_allclose(found[kind], sticky[kind], rtol=0.2, err_msg=kind)
