"""StabilityWarning: a runner says once that its gains pass the stability bound, of which joint and
by how much.
"""

import dataclasses
import warnings

import numpy as np
import pytest
from tiny_urdf import joint, link, robot, write

import batchpid as bp
from batchpid.sim import Robot, Runner, StabilityWarning
from batchpid.sim.tuning import tune

BAD, GOOD = {"kp": 10.0, "ki": 0.0, "kd": [1.0, 5e4]}, {"kp": 10.0, "ki": 0.0, "kd": 1.0}


@pytest.fixture
def arm(tmp_path):
    return Robot.load(
        write(tmp_path, robot(*map(link, "abc"), joint("one", "a", "b"), joint("two", "b", "c")))
    )


def warned(call):
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        runner = call()
    seen = [each for each in seen if each.category is StabilityWarning]
    assert all(each.filename == __file__ for each in seen)
    return runner, [str(each.message) for each in seen]


def make(arm, num_envs=1, **options):
    return Runner(arm, num_envs, **{"workers": 0, "collisions": False} | options)


def test_it_names_joint_factor_and_remedy_at_construction_and_assignment(arm):
    runner, (message,) = warned(lambda: make(arm, params=arm.params(**BAD)))
    with runner:
        checked = arm.check(params=arm.params(**BAD))
        (finding,) = (one for one in checked if one.code == "unstable")
        factor = finding.detail.split(" times")[0]
        assert f"gains are {factor} times the stability bound" in message
        assert "mostly of joint 'two', at the start pose with a time step of 0.0005 s" in message
        assert "use at most" in message
        assert finding.remedy.split(" times")[0] in message

        def assign(params):
            runner.params = params

        assert warned(lambda: assign(arm.params(**BAD)))[1] == []  # beyond as before
        assert warned(lambda: assign(arm.params(**GOOD)))[1] == []
        assert len(warned(lambda: assign(arm.params(**BAD)))[1]) == 1


def test_the_env_is_named_and_the_remedy_works(arm):
    kd = np.tile([1.0, 1.0], (5, 1))
    kd[3, 0] = 5e4
    runner, (message,) = warned(lambda: make(arm, 5, params=arm.params(kp=10.0, ki=0.0, kd=kd)))
    runner.close()
    assert "joint 'one', env 3" in message
    scale = float(message.split("use at most ")[1].split(" times")[0])
    runner, none = warned(
        lambda: make(arm, 5, params=arm.params(kp=10.0 * scale, ki=0.0, kd=kd * scale))
    )
    runner.close()
    assert none == []


@pytest.mark.parametrize(
    "options",
    [
        {"params": GOOD},
        {"params": BAD, "control": "drive"},
        {"params": BAD, "control": "effort"},
        {"params": BAD | {"derivative_filter_time": 10.0}},
        {"params": BAD, "actuators": {"strength": 1e-3}},
        {"params": GOOD, "actuators": {"command_delay": 0.01}},
        {"params": BAD, "actuators": {"armature": 100.0}},
    ],
    ids=str,
)
def test_there_is_none_within_the_bound_and_where_it_does_not_hold(arm, options):
    options = {**options, "params": arm.params(**options["params"])}
    if "actuators" in options:
        options["actuators"] = bp.make_actuators(2, **options["actuators"])
    runner, none = warned(lambda: make(arm, **options))
    runner.close()
    assert none == []


@pytest.mark.parametrize("late", ["command_delay", "sensor_delay"])
def test_motors_that_are_late_lower_the_bound(arm, late):
    """Gains within the bound of ideal motors; the env with late motors is named, and the remedy
    works.
    """
    delays = np.zeros((3, 2))
    delays[2] = 0.01
    bad, motors = {"kp": 500.0, "ki": 0.0, "kd": 300.0}, bp.make_actuators(2, **{late: delays})
    runner, none = warned(lambda: make(arm, 3, params=arm.params(**bad)))
    runner.close()
    assert none == []
    runner, (message,) = warned(lambda: make(arm, 3, params=arm.params(**bad), actuators=motors))
    runner.close()
    assert "env 2" in message
    assert "oscillates" in message
    real = dataclasses.replace(arm, actuators=motors.for_envs(slice(2, 3)))
    assert any(each.code == "unstable" for each in real.check(params=arm.params(**bad)))
    scale = float(message.split("use at most ")[1].split(" times")[0])
    good = {name: scale * gain for name, gain in bad.items()}
    runner, none = warned(lambda: make(arm, 3, params=arm.params(**good), actuators=motors))
    runner.close()
    assert none == []


def test_bundled_gains_do_not_warn(panda, jaco2):
    for each in (panda, jaco2):
        for params in (each.tuned(), *map(each.designed, ("effort", "mass_matrix"))):
            runner, none = warned(lambda each=each, params=params: make(each, params=params))
            runner.close()
            assert none == []


def test_candidates_of_a_search_do_not_warn(arm):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.simplefilter("error", StabilityWarning)
        tune(arm, generations=1, seconds=0.1, workers=0)
