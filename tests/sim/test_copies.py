"""Objects that own processes, scenes or files refuse to be copied or pickled, and go on."""

from __future__ import annotations

import copy
import pickle
import re

import cloudpickle
import pytest
from tiny_urdf import one_joint, write

from batchpid.errors import NotCopyableError
from batchpid.sim import Recorder, Robot, Runner

COPIES = (copy.copy, copy.deepcopy, pickle.dumps, cloudpickle.dumps)


@pytest.fixture
def hinge(tmp_path):
    return Robot.load(write(tmp_path, one_joint()))


def refuses(value, advice=""):
    for make in COPIES:
        with pytest.raises(
            NotCopyableError, match=f"a {type(value).__name__} can be neither .*{re.escape(advice)}"
        ):
            make(value)


@pytest.mark.parametrize("workers", [0, 1])
def test_a_runner(hinge, workers):
    with Runner(hinge, 1, workers=workers) as runner:
        refuses(runner, "restore a runner.snapshot() in it")
        assert runner.step([0.1]).ok.all()
    with pytest.raises(NotCopyableError):
        copy.copy(runner)  # a closed one, too


def test_a_recorder(hinge, tmp_path):
    with Runner(hinge, 1, workers=0) as runner, Recorder(tmp_path / "run.h5", runner) as recorder:
        refuses(recorder, "another Recorder")
        runner.step([0.1])


def test_an_environment(hinge):
    pytest.importorskip("gymnasium")
    from batchpid.sim.gym import ReachEnv, ReachVectorEnv

    for env in (ReachVectorEnv(1, hinge, workers=0), ReachEnv(hinge)):
        env.reset(seed=0)
        refuses(env, "the same arguments")
        env.step(env.action_space.sample())
        env.close()
