"""Arrays of a caller are copied at the boundary; writing to arrays that objects hand out is refused,
or changes a copy; objects that own processes, scenes or files refuse to be copied, and go on.
"""

import copy
import pickle
import re

import cloudpickle
import numpy as np
import pytest
from option_values import ARM, VALUES
from tiny_urdf import gripper, one_joint, write

import batchpid as bp
from batchpid.errors import NotCopyableError
from batchpid.sim import (
    Randomization,
    Robot,
    Runner,
    RunnerOptions,
    Uniform,
)

COPIES = (copy.copy, copy.deepcopy, pickle.dumps, cloudpickle.dumps)


def arrays(value, path="", seen=None):
    """Yield every array that the public attributes of an object lead to, with its path."""
    seen = {} if seen is None else seen
    if isinstance(value, np.ndarray):
        yield path, value
        return
    if isinstance(value, dict):
        parts = [(f"{path}[{key!r}]", entry) for key, entry in value.items()]
    elif isinstance(value, list | tuple) and not hasattr(value, "_fields"):
        parts = [(f"{path}[{index}]", entry) for index, entry in enumerate(value)]
    elif type(value).__module__.split(".")[0] in ("sim", "batchpid") and id(value) not in seen:
        seen[id(value)] = value  # alive, so that no other object gets its number
        names = [name for name in dir(value) if not name.startswith("_")]
        parts = [(f"{path}.{name}", getattr(value, name, None)) for name in names]
    else:
        return
    for at, entry in parts:
        yield from arrays(entry, at, seen)


def scribble(value):
    """Overwrite every array of a value that can be written to."""
    for _, array in arrays(value):
        if array.flags.writeable:
            array[...] = 77


def check(value):
    """Write to all arrays, and look at them again."""
    before = {path: array.copy() for path, array in arrays(value)}
    assert len(before) > 5
    scribble(value)
    after = dict(arrays(value))
    for path, array in before.items():
        np.testing.assert_array_equal(after[path], array, err_msg=path)


def own(value):
    """Return a copy of an option that can be written to: of leaves, or of numbers of joints."""
    if hasattr(value, "_fields"):
        return type(value)(
            *(np.array(leaf) if isinstance(leaf, np.ndarray) else leaf for leaf in value)
        )
    return np.array(value) if isinstance(value, list) and type(value[0]) is float else value


# -- arrays of the caller


@pytest.mark.parametrize("name", ["params", "actuators", "guard", "plan"])
def test_options_are_copied(name):
    for value in map(own, VALUES[name][-2:]):  # the first may be without arrays
        options = {"robot": ARM, "num_envs": 2, name: value}
        found = RunnerOptions(**options)
        before = {path: array.copy() for path, array in arrays({name: getattr(found, name)})}
        scribble(value)
        for path, array in arrays({name: getattr(found, name)}):
            np.testing.assert_array_equal(array, before[path])
            assert not array.flags.writeable


# -- arrays that objects hand out


@pytest.fixture(scope="module")
def hand(tmp_path_factory):
    path = write(tmp_path_factory.mktemp("hand"), gripper())
    return Robot.load(path, actuators=bp.make_actuators(2, lag=0.01))


def test_of_a_robot(panda, hand):
    check(panda)
    check(hand)
    check(hand.dynamics())


def test_of_a_runner(hand):
    drawn = Randomization(payload=Uniform(0, 1), params={"kp": Uniform(-0.1, 0.1)})
    options = {"workers": 0, "guard": True, "randomization": drawn}
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


# -- objects that cannot be copied


@pytest.fixture
def hinge(tmp_path):
    return Robot.load(write(tmp_path, one_joint()))


def refuses(value, advice=""):
    for make in COPIES:
        with pytest.raises(
            NotCopyableError, match=f"a {type(value).__name__} can be neither .*{re.escape(advice)}"
        ):
            make(value)


def test_a_controller():
    pid = bp.BatchPID(bp.make_params(2, kp=1.0, ki=1.0), 3, 1e-3)
    pid(np.ones((3, 2)), np.zeros((3, 2)))
    refuses(pid)
    with pytest.raises(ValueError, match="read-only"):
        pid.state.integral[...] = 0


@pytest.mark.parametrize("workers", [0, 1])
def test_a_runner(hinge, workers):
    with Runner(hinge, 1, workers=workers) as runner:
        refuses(runner, "restore a runner.snapshot() in it")
        assert runner.step([0.1]).ok.all()
    with pytest.raises(NotCopyableError):
        copy.copy(runner)  # a closed one, too


def test_an_environment(hinge):
    pytest.importorskip("gymnasium")
    from batchpid.sim.gym import ReachEnv, ReachVectorEnv

    for env in (ReachVectorEnv(1, hinge, workers=0), ReachEnv(hinge)):
        env.reset(seed=0)
        refuses(env, "the same arguments")
        env.step(env.action_space.sample())
        env.close()
