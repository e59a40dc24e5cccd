"""Snapshots: their content, and files that are damaged, of another format, or malicious.

test_conformance.py shows that a run goes on from a snapshot bit by bit, test_state_belongs.py which
runners refuse it.
"""

import json
import os
import pickle
import re
import subprocess
import sys

import numpy as np
import pytest
from identical import assert_identical
from option_values import ARM

from batchpid.errors import InvalidArgumentError
from batchpid.sim import Randomization, Runner, Snapshot, Uniform

N = 2
GOAL = np.full(ARM.dof, 0.2)


def make(**options):
    params = ARM.params(kp=20.0, ki=5.0, kd=2.0, anti_windup="back_calculation", effort_limit=5.0)
    return Runner(
        ARM, N, **{"params": params, "workers": 0, "on_invalid_input": "contain", **options}
    )


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    path = tmp_path_factory.mktemp("snapshot") / "good.npz"
    with make() as runner:
        runner.step(GOAL, setpoint_rate=0.1 * GOAL)
        runner.snapshot().save(path)
    return path


# -- content
# --------------------------------------------------------------------------------------------------


def test_a_new_process_and_a_copy_go_on_from_it(jaco2, tmp_path):
    noise = np.random.default_rng(0).uniform(-0.5, 0.5, (6, N, jaco2.dof))
    table = np.clip(jaco2.settings.target + noise, jaco2.lower, jaco2.upper)
    with Runner(jaco2, N, workers=0, params=jaco2.params()) as runner:
        runner.rollout(table[:3])
        snapshot = runner.snapshot()
        went_on = runner.rollout(table[3:])
        runner.restore(pickle.loads(pickle.dumps(snapshot)))
        assert_identical(runner.rollout(table[3:]), went_on)
    snapshot.save(tmp_path / "s.npz")
    np.save(tmp_path / "table.npy", table[3:])
    program = (
        "import sys, numpy as np; from batchpid.sim import *; folder = sys.argv[1] + '/'; robot ="
        f" Robot.load('jaco2')\nwith Runner(robot, {N}, params=robot.params(), workers=0) as"
        " runner:\n    runner.restore(Snapshot.load(folder + 's.npz'))\n    np.save(folder +"
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


# -- files
# --------------------------------------------------------------------------------------------------


def read(path):
    """Return the arrays of a file by name, and its head as a mapping."""
    with np.load(path) as file:
        content = dict(file)
    return content | {"head": json.loads(str(content["head"]))}


def write(path, content):
    np.savez(path, **content | {"head": np.array(json.dumps(content["head"]))})
    return path


def damage(content, *place):
    """Change the entry of a content at a place, whose last part is a function of the entry or its
    value; without one the entry is removed.
    """
    *folders, name, change = place
    for folder in folders:
        content = content[folder]
    entry = content.pop(name, None)
    if change is not ...:
        content[name] = change(entry) if callable(change) else change


def gains(text):
    """Return a function that replaces kp in the text of the params."""
    return lambda params: re.sub(r'(?<="kp": )([-\d.]+|\[[^]]*\])', text, params)


ABOUT, TEXT = ("head", "about"), ("head", "params")
DAMAGES = {
    "an older format": ("head", "format", 2),
    "negative steps": ("head", "steps", -1),
    "an unknown choice": (*TEXT, lambda params: params.replace('"explicit"', '"evil"')),
    "no params": (*TEXT, None),
    "more envs than memory": (*ABOUT, "num_envs", 10**12),
    "fewer joints": (*ABOUT, "joints", ["a"]),
    "a randomization without episodes": (*ABOUT, "randomization", {}),
    "no integral": ("control/law/integral", ...),
    "an unknown array": ("more", np.zeros(1)),
    "text": ("engine", lambda rows: rows.astype("U8")),
    "no options": (*ABOUT, None),
    "short rows": ("engine", lambda rows: rows[:, 1:]),
    "rows of other content": ("engine", lambda rows: rows * np.nan),
    "an effort of one env": ("effort", lambda rows: rows[:1]),
    "negative gains": (*TEXT, gains("-1")),
    "another precision": ("engine", np.float32),
    "one env": ("engine", lambda rows: rows[:1]),
    "long rows": ("engine", lambda rows: np.pad(rows, ((0, 0), (0, 1)))),
    "gains that are not numbers": (*TEXT, gains("NaN")),
    "a motion of one row": ("motion", lambda rows: rows[:1]),
}


@pytest.fixture(scope="module")
def runner():
    with make() as made:
        yield made


@pytest.mark.parametrize("name", DAMAGES)
def test_a_damaged_snapshot_is_refused_before_anything_changes(good, runner, name, tmp_path):
    runner.restore(Snapshot.load(write(tmp_path / "rewritten.npz", read(good))))
    content, before = read(good), runner.observe()
    damage(content, *DAMAGES[name])
    with pytest.raises(InvalidArgumentError) as caught:
        runner.restore(Snapshot.load(write(tmp_path / "bad.npz", content)))
    assert caught.value.argument in ("path", "snapshot")
    assert_identical(before, runner.observe())
    assert runner.step(GOAL).ok.all()


@pytest.mark.parametrize(
    "change",
    [lambda rows: rows[:1], lambda rows: rows.astype(float), lambda rows: rows - 9, ...],
)
def test_episodes_that_do_not_agree_are_refused(change, tmp_path):
    path = tmp_path / "drawn.npz"
    with make(randomization=Randomization(payload=Uniform(0, 0.5)), params=None) as runner:
        runner.snapshot().save(path)
        content = read(path)
        runner.restore(Snapshot.load(write(path, content)))
        damage(content, "episodes", change)
        with pytest.raises(InvalidArgumentError):
            runner.restore(Snapshot.load(write(path, content)))


def test_what_is_no_snapshot_is_refused_and_not_executed(good, tmp_path):
    class Evil:
        def __reduce__(self):
            return (tmp_path.joinpath("ran").touch, ())

    encrypted = bytearray(good.read_bytes())
    encrypted[encrypted.index(b"PK\x01\x02") + 8] |= 1
    contents = {
        "empty": b"",
        "text": b"hello",
        "pickle": pickle.dumps(Evil()),
        "encrypted": encrypted,
    }
    for name, content in contents.items():
        (tmp_path / name).write_bytes(content)
    np.savez(tmp_path / "objects.npz", head=np.array([Evil()], dtype=object))
    np.savez(tmp_path / "others.npz", other=np.zeros(3))
    os.mkfifo(tmp_path / "pipe")
    for name in (*contents, "objects.npz", "others.npz", "pipe", ".", "missing", "x" * 5000):
        with pytest.raises(InvalidArgumentError):
            Snapshot.load(tmp_path / name)
    assert not (tmp_path / "ran").exists()
