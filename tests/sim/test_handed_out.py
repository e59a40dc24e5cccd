"""Arrays that objects hand out: writing to them is refused, or changes a copy."""

from __future__ import annotations

import numpy as np
import pytest
from tiny_urdf import gripper, write

import batchpid as bp
from batchpid.sim import FaultWarning, Randomization, Robot, Runner, Uniform


def arrays(value, path="", seen=None):
    """Yield every array that the public attributes of an object lead to, with its path."""
    seen = set() if seen is None else seen
    if isinstance(value, np.ndarray):
        yield path, value
        return
    if isinstance(value, dict):
        parts = [(f"{path}[{key!r}]", entry) for key, entry in value.items()]
    elif isinstance(value, list | tuple) and not hasattr(value, "_fields"):
        parts = [(f"{path}[{index}]", entry) for index, entry in enumerate(value)]
    elif type(value).__module__.split(".")[0] in ("sim", "batchpid") and id(value) not in seen:
        seen.add(id(value))
        names = [name for name in dir(value) if not name.startswith("_")]
        parts = [(f"{path}.{name}", getattr(value, name, None)) for name in names]
    else:
        return
    for at, entry in parts:
        yield from arrays(entry, at, seen)


def check(value):
    """Write to all arrays, and look at them again."""
    before = {path: array.copy() for path, array in arrays(value)}
    assert len(before) > 5
    kept = []
    for path, array in arrays(value):
        kept.append(path)
        if array.flags.writeable:
            array[...] = 77
    after = dict(arrays(value))
    for path in kept:
        np.testing.assert_array_equal(after[path], before[path], err_msg=path)


@pytest.fixture(scope="module")
def hand(tmp_path_factory):
    path = write(tmp_path_factory.mktemp("hand"), gripper())
    return Robot.load(path, actuators=bp.make_actuators(2, lag=0.01))


def test_of_a_robot(panda, hand):
    check(panda)
    check(hand)
    check(hand.dynamics())


def test_of_a_runner(hand):
    speed_limit = np.full(2, 90.0)
    drawn = Randomization(payload=Uniform(0, 1), params={"kp": Uniform(-0.1, 0.1)})
    options = {"workers": 0, "speed_limit": speed_limit, "guard": True, "randomization": drawn}
    with Runner(hand, 2, **options) as runner:
        rollout = runner.rollout(np.zeros((2, 2)))
        snapshot = runner.snapshot()
        for value in (runner, snapshot.params, rollout.info.params):
            check(value)
        runner.info.versions["numpy"] = "another"
        assert runner.info.versions["numpy"] == np.__version__


def test_writes_to_a_snapshot_do_not_reach_the_runner(panda):
    def run(write):
        options = {"randomization": Randomization(payload=Uniform(0, 1))}
        with Runner(panda, 1, workers=0, **options) as runner:
            runner.reset(panda.settings.target)
            taken, restored = runner.snapshot(), runner.snapshot()
            runner.restore(restored)
            if write:
                taken.rows["episodes"][:] = 7
            after = runner.step(panda.settings.target)
            return after.qpos, runner.reset() and runner.draws["payload"]

    for mine, other in zip(run(write=True), run(write=False), strict=True):
        np.testing.assert_array_equal(mine, other)


def test_faults_are_immutable(hand):
    with Runner(hand, 2, workers=0, on_invalid_input="contain") as runner:
        with pytest.warns(FaultWarning):
            runner.step(np.full(2, np.nan))
        assert isinstance(runner.faults, tuple)
        assert len(runner.faults) == 2


def test_of_a_controller():
    pid = bp.BatchPID(
        bp.make_params(2, kp=1.0, ki=1.0, kd=1.0, effort_rate_limit=5.0), 3, 1e-3, terms=True
    )
    pid(np.ones((3, 2)), np.zeros((3, 2)))
    check(pid)
    with pytest.raises(ValueError, match="read-only"):
        pid.state.integral[...] = 0
