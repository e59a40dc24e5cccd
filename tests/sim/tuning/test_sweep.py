"""A sweep is the rollout of one runner, in parts; killed at any moment it ends with the same file."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
from option_values import ARM, box
from processes import PATIENCE

import batchpid as bp
from batchpid.errors import InvalidArgumentError
from batchpid.sim import FaultWarning, Randomization, Runner, Uniform, read_recording, sweep

SETPOINTS = np.tile(ARM.start + 0.2, (6, 1))
SHORT = {"workers": 0, "substeps": 4, "engine": "mujoco"}
NOISE = bp.make_actuators(2, position_noise=0.01)


def gains(envs):
    """Return gains with a row for each env."""
    return ARM.params(kp=5.0 + 0.01 * envs[:, None] * np.ones(2), ki=1.0, kd=2.0)


def starts(envs):
    """Return start poses, one for each env."""
    return ARM.start + 0.0004 * envs[:, None]


def content(path):
    """Return all arrays and attributes of a recording, but the time of the day."""
    with h5py.File(path) as file:
        attributes = {name: np.asarray(value).tolist() for name, value in file.attrs.items()}
        arrays = {name: (str(rows.dtype), rows[:].tobytes()) for name, rows in file.items()}
    return arrays | {name: value for name, value in attributes.items() if name not in ("begun", "checksum")}


OPTIONS = {
    "randomization": {"randomization": Randomization(payload=Uniform(0, 1)), "seed": 3},
    "noise": {"actuators": NOISE},
    "guard rows": {"guard": bp.make_guard(2, rate=np.linspace(0.1, 2.0, 20)[:, None] * np.ones(2))},
    "faults": {"speed_limit": 1e-3},
    "content": {"build": box, "engine": "sapien"},
}


@pytest.mark.filterwarnings("ignore::batchpid.sim.FaultWarning")
@pytest.mark.parametrize("name", OPTIONS)
def test_it_is_the_rollout_of_one_runner(name, tmp_path):
    options = SHORT | OPTIONS[name] | ({"build": content_of_env} if name == "content" else {})
    found = sweep(ARM, 20, SETPOINTS, tmp_path / "a.h5", params=gains, qpos=starts, part=8, **options)
    numbers, seed = np.arange(20), options.pop("seed", None)
    with Runner(ARM, 20, params=gains(numbers), **options) as runner:
        runner.reset(starts(numbers), seed=seed)
        expected = runner.rollout(SETPOINTS)
    for each in (found, read_recording(tmp_path / "a.h5")):
        for key, rows in expected.arrays().items():
            np.testing.assert_array_equal(each.arrays()[key], rows, err_msg=key)
        assert each.info.faults == expected.info.faults
        np.testing.assert_array_equal(each.info.start, expected.info.start)
        np.testing.assert_array_equal(each.info.params.kp, expected.info.params.kp)
        assert repr(each.info.draws) == repr(expected.info.draws)
    assert (len(found.info.faults) > 8) == (name == "faults")
    assert [path.name for path in tmp_path.iterdir()] == ["a.h5"]


def content_of_env(scene, env):
    """Build a box next to the robot, farther away for each env."""
    return box(0.05, scene, env)


def test_a_file_of_another_sweep_is_refused_by_the_names_of_its_inputs(tmp_path, monkeypatch):
    path = tmp_path / "a.h5"
    known = {"params": gains, "part": 2, **SHORT}
    made = sweep(ARM, 4, SETPOINTS, path, **known)
    monkeypatch.setattr("batchpid.sim.tuning.sweep.Runner", None)  # nothing runs again
    again = sweep(ARM, 4, SETPOINTS, path, **known | {"part": 3})
    np.testing.assert_array_equal(again.qpos, made.qpos)
    others = {
        "setpoints": {"setpoints": SETPOINTS + 0.1},
        "params": {"params": ARM.params(kp=1.0, ki=0.0, kd=1.0)},
        "substeps": {"substeps": 5},
        "num_envs": {"num_envs": 5},
    }
    for name, other in others.items():
        with pytest.raises(
            InvalidArgumentError, match=rf"path: is of another sweep \({name}(, params, qpos, qvel)? differ\)"
        ):
            sweep(**{"robot": ARM, "num_envs": 4, "setpoints": SETPOINTS, "path": path, **known, **other})
    (tmp_path / "b.h5.parts").mkdir()
    path.rename(tmp_path / "b.h5.parts" / "0.h5")
    with pytest.raises(InvalidArgumentError, match=r"path: is of another sweep \(params differ\).*b.h5.parts/0.h5"):
        sweep(ARM, 4, SETPOINTS, tmp_path / "b.h5", **known | others["params"])


def test_a_recording_that_is_no_sweep_stays(tmp_path):
    with Runner(ARM, 1, **SHORT) as runner:
        bp.sim.write_recording(runner.rollout(SETPOINTS), tmp_path / "a.h5")
    with pytest.raises(InvalidArgumentError, match=r"path: is no sweep .*name another file"):
        sweep(ARM, 1, SETPOINTS, tmp_path / "a.h5", **SHORT)


def test_rows_that_are_not_one_for_each_env_are_refused(tmp_path):
    for name, value in {
        "setpoints": np.zeros((6, 3, 2)),
        "qpos": np.zeros((3, 2)),
        "params": gains(np.arange(3)),
    }.items():
        with pytest.raises(InvalidArgumentError, match=name):
            sweep(
                **{"robot": ARM, "num_envs": 4, "setpoints": SETPOINTS, "path": tmp_path / "a.h5", name: value}, **SHORT
            )
    assert not [*tmp_path.iterdir()]


def test_a_fault_is_named_by_the_number_of_its_env(tmp_path):
    rows = np.tile(ARM.start, (4, 1)) + np.array([0.0, 0.0, 0.0, 1.0])[:, None]
    with pytest.warns(FaultWarning, match="1 in envs 2 to 3, the first: env 3, joint"):
        sweep(ARM, 4, np.tile(ARM.start, (6, 1)), tmp_path / "a.h5", qpos=rows, part=2, speed_limit=0.01, **SHORT)


PROGRAM = """
import sys
sys.path[:0] = sys.argv[4:]
from test_sweep import ARM, SETPOINTS, SHORT, gains, starts
from batchpid.sim import sweep
sweep(ARM, int(sys.argv[2]), SETPOINTS, sys.argv[1], params=gains, qpos=starts, part=int(sys.argv[3]), **SHORT)
"""


@pytest.mark.parametrize(("sets", "parts", "kills"), [(8, 4, 1), pytest.param(2000, 20, 10, marks=pytest.mark.slow)])
def test_killed_at_random_moments_it_ends_with_the_same_file(sets, parts, kills, tmp_path):
    folder, chance, done = tmp_path / "a.h5.parts", np.random.default_rng(0), 0
    paths = [str(Path(__file__).parents[1]), str(Path(__file__).parent)]
    program = [sys.executable, "-c", PROGRAM, str(tmp_path / "a.h5"), str(sets), str(sets // parts), *paths]
    for kill in range(kills):
        with subprocess.Popen(program) as child:
            wanted, end = (parts - 2) * (kill + 1) // kills, time.monotonic() + PATIENCE
            while child.poll() is None and done < wanted and time.monotonic() < end:
                done = len([*folder.glob("[0-9]*.h5")])
                time.sleep(0.005)
            time.sleep(chance.uniform(0, 0.05))
            child.send_signal(signal.SIGKILL)
        assert child.returncode == -signal.SIGKILL
        assert not (tmp_path / "a.h5").exists()
    subprocess.run(program, check=True)
    assert [path.name for path in tmp_path.iterdir()] == ["a.h5"]
    sweep(ARM, sets, SETPOINTS, tmp_path / "b.h5", params=gains, qpos=starts, part=sets // parts, **SHORT)
    assert content(tmp_path / "a.h5") == content(tmp_path / "b.h5")
