"""Snapshots: their content, and rows that do not fit.

test_conformance.py shows that a run goes on from a snapshot bit by bit, test_state_belongs.py which
runners refuse it.
"""

import pickle
import subprocess
import sys
from dataclasses import dataclass

import numpy as np
import pytest
from identical import assert_identical
from option_values import ARM

from batchpid.errors import InvalidArgumentError
from batchpid.sim import Runner
from batchpid.stages import Stage

N = 2
GOAL = np.full(ARM.dof, 0.2)


def make(**options):
    params = ARM.params(kp=20.0, ki=5.0, kd=2.0, anti_windup="back_calculation", effort_limit=5.0)
    return Runner(
        ARM, N, **{"params": params, "workers": 0, "on_invalid_input": "contain", **options}
    )


def test_a_new_process_and_a_copy_go_on_from_it(jaco2, tmp_path):
    noise = np.random.default_rng(0).uniform(-0.5, 0.5, (6, N, jaco2.dof))
    table = np.clip(jaco2.settings.target + noise, jaco2.lower, jaco2.upper)
    with Runner(jaco2, N, workers=0, params=jaco2.params()) as runner:
        runner.rollout(table[:3])
        snapshot = runner.snapshot()
        went_on = runner.rollout(table[3:])
        runner.restore(pickle.loads(pickle.dumps(snapshot)))
        assert_identical(runner.rollout(table[3:]), went_on)
    (tmp_path / "s.pickle").write_bytes(pickle.dumps(snapshot))
    np.save(tmp_path / "table.npy", table[3:])
    program = (
        "import pickle, sys, numpy as np; from batchpid.sim import *; folder = sys.argv[1] + '/'; robot ="
        f" Robot.load('jaco2')\nwith Runner(robot, {N}, params=robot.params(), workers=0) as"
        " runner:\n    runner.restore(pickle.load(open(folder + 's.pickle', 'rb')))\n    np.save(folder +"
        " 'qpos.npy', runner.rollout(np.load(folder + 'table.npy')).qpos)\n"
    )
    environment = {"PYTHONPATH": ":".join(filter(None, sys.path)), "PATH": ""}
    subprocess.run(
        [sys.executable, "-W", "ignore", "-c", program, tmp_path], check=True, env=environment
    )
    np.testing.assert_array_equal(np.load(tmp_path / "qpos.npy"), went_on.qpos)


def test_it_holds_faults_params_and_time():
    with make() as runner:
        with pytest.warns(UserWarning, match="env 1"):
            runner.step([GOAL, [np.nan, 0.0]])
        runner.params = ARM.params(kp=30.0)
        snapshot, time = runner.snapshot(), runner.time
        expected = runner.step(GOAL)
    with make() as other:
        other.restore(snapshot)
        assert (other.time, other.params.kp.max(), other.faults) == (time, 30.0, ())
        seen = other.step(GOAL)
        for envs in ([N], [0.0]):
            with pytest.raises(IndexError):
                snapshot.for_envs(envs)
    assert seen.ok.tolist() == [True, False]
    assert_identical(seen, expected)


DAMAGES = {
    "an unknown array": ("more", lambda rows: np.zeros(1)),
    "text": ("engine", lambda rows: rows.astype("U8")),
    "short rows": ("engine", lambda rows: rows[:, 1:]),
    "rows of other content": ("engine", lambda rows: rows * np.nan),
    "an effort of one env": ("effort", lambda rows: rows[:1]),
    "another precision": ("engine", np.float32),
    "a motion of one row": ("motion", lambda rows: rows[:1]),
    "a state of another controller": ("control/law/state", lambda rows: rows[:, :1]),
    "a state of another stage": ("control/drift", lambda rows: rows[:, :1]),
}


class Spring:
    def init(self, robot, num_envs):
        return np.zeros((num_envs, robot.dof))

    def __call__(self, state, setpoint, qpos, qvel, passive):
        return state, passive - qvel - qpos


@dataclass(frozen=True)
class Drift(Stage):
    name = "drift"
    after = "limits"

    def init(self, values):
        return 0.0 * values.measured.qpos, values

    def step(self, state, values):
        return state + 1.0, values


@pytest.fixture(scope="module")
def runners():
    with make() as batchpids, make(control=Spring(), stages=[Drift()]) as own:
        yield batchpids, own


@pytest.mark.parametrize("name", DAMAGES)
def test_other_rows_are_refused_before_anything_changes(runners, name):
    place, change = DAMAGES[name]
    runner = runners["control" in place]
    snapshot = runner.snapshot()
    before = runner.observe()
    snapshot.rows[place] = change(snapshot.rows.get(place))
    with pytest.raises(InvalidArgumentError, match="snapshot"):
        runner.restore(snapshot)
    assert_identical(before, runner.observe())
    assert runner.step(GOAL).ok.all()
