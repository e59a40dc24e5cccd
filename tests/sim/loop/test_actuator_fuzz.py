"""Random actuators in the runner: no crash, and no NaN that goes unnoticed; lost workers leave no
trace.
"""

import warnings

import numpy as np
import pytest
from option_values import FRICTION, LINE, NOISE, SENSORS, SIGNALS

import batchpid as bp
from batchpid.sim import FaultWarning, Runner

ENVS = 10
SCALES = SIGNALS | SENSORS | NOISE | LINE | FRICTION
del SCALES["static"], SCALES["stribeck"]


def random_actuators(seed, dof):
    """Return actuators of ENVS settings over five decades, with about half of the effects on."""
    rng = np.random.default_rng(seed)
    on = {name for name in SCALES if rng.random() < 0.5}
    on = on | {"saturation_effort"} if "no_load_speed" in on else on - {"saturation_effort"}
    options = {name: SCALES[name] * 10.0 ** rng.uniform(-4, 1, (ENVS, dof)) for name in sorted(on)}
    if "coulomb" in on and rng.random() < 0.5:
        options["static"] = options["coulomb"] * rng.uniform(1, 3, (ENVS, dof))
        options["stribeck"] = rng.choice([0.0, 0.01, 0.3], (ENVS, dof))
    return bp.make_actuators(dof, **options, seed=seed)


def check(robot, seeds):
    rng = np.random.default_rng(seeds[0])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FaultWarning)
        for seed in seeds:
            actuators = random_actuators(seed, robot.dof)
            setpoints = rng.normal(0, 1, (4, ENVS, robot.dof)).clip(robot.lower, robot.upper)
            with Runner(robot, ENVS, workers=0, substeps=10, actuators=actuators) as runner:
                rollout = runner.rollout(setpoints)
            for rows in (rollout.qpos, rollout.qvel, rollout.effort):
                assert np.isfinite(rows[rollout.ok]).all(), seed
            if (limit := actuators.effort_limit) is not None:
                assert (np.abs(rollout.effort) <= np.float32(limit) * (1 + 1e-6)).all(), seed


def test_30_random_settings(panda):
    check(panda, range(3))


@pytest.mark.slow
def test_1000_random_settings(panda, jaco2):
    check(panda, range(100, 150))
    check(jaco2, range(200, 250))
