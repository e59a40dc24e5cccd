"""Snapshots: their content, and files that are damaged, of another format, or malicious.

test_conformance.py shows that a run goes on from a snapshot bit by bit, test_state_belongs.py which
runners refuse it.
"""

from __future__ import annotations

import dataclasses
import json
import os
import pickle
import subprocess
import sys
import tracemalloc
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from identical import assert_identical
from option_values import ARM, label
from robots import load_bundled

import batchpid as bp
from batchpid.errors import BatchPIDError, InvalidArgumentError
from batchpid.sim import Randomization, Robot, Runner, Snapshot, Uniform

N = 2
GOAL = np.full(ARM.dof, 0.2)


def make(**options: Any) -> Runner:
    params = ARM.params(kp=20.0, ki=5.0, kd=2.0, anti_windup="back_calculation", effort_limit=5.0)
    return Runner(
        ARM, N, **{"params": params, "workers": 0, "on_invalid_input": "contain", **options}
    )


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("snapshot") / "good.npz"
    with make() as runner:
        runner.step(GOAL, setpoint_rate=0.1 * GOAL)
        runner.snapshot().save(path)
    return path


# -- content
# --------------------------------------------------------------------------------------------------


def test_a_new_process_and_a_copy_go_on_from_it(jaco2: Robot, tmp_path: Path) -> None:
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


def test_in_free_motion_the_barrier_changes_the_last_bits_only(monkeypatch) -> None:
    results = []
    for checkpoint_steps in (8000, 40):
        monkeypatch.setattr("batchpid.sim.runner.runner.CHECKPOINT_STEPS", checkpoint_steps)
        with make(ground=False) as runner:
            results.append(runner.rollout(np.tile(GOAL, (20, 1))))
    np.testing.assert_allclose(results[0].qpos, results[1].qpos, rtol=0, atol=1e-7)
    assert np.abs(results[0].qpos[-1]).max() > 1e-3


def test_it_holds_faults_params_and_time() -> None:
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
    assert seen.ok.tolist() == [True, False]
    assert_identical(seen, expected)


def test_it_is_immutable_and_equals_itself_alone(good: Path) -> None:
    snapshot = Snapshot.load(good)
    for each in (snapshot, snapshot.states):
        assert "\n" not in repr(each)
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(each, dataclasses.fields(each)[0].name, None)
        assert len({each, dataclasses.replace(each)}) == 2


# -- files
# --------------------------------------------------------------------------------------------------


def read(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the head of a file and its arrays."""
    with np.load(path) as file:
        tables = dict(file)
    return json.loads(str(tables.pop("head"))), tables


def write(
    path: Path, head: Any, tables: dict[str, Any], save: Callable[..., None] = np.savez
) -> Path:
    save(path, head=np.array(json.dumps(head)), **tables)
    return path


def head(**changes: Any) -> Callable[..., None]:
    return lambda head, tables: head.update(changes)


def about(**changes: Any) -> Callable[..., None]:
    return lambda head, tables: head["about"].update(changes)


def array(name: str, change: Callable[[np.ndarray], Any] | None) -> Callable[..., None]:
    """Return a damage that changes an array, or removes it."""

    def damage(head: Any, tables: dict[str, Any]) -> None:
        if change is None:
            del tables[name]
        else:
            tables[name] = change(tables.get(name))

    return damage


DAMAGES = {
    "an older format": head(format=2),
    "no description": head(about=None),
    "an empty description": head(about=[]),
    "negative steps": head(steps=-1),
    "half a step": head(steps=1.5),
    "more steps than an integer holds": head(steps=10**30),
    "an unknown choice": head(choices={"anti_windup": "Evil"}),
    "the choice of another field": head(choices={"kp": "Everywhere"}),
    "more envs than memory": about(num_envs=10**12),
    "more envs than rows": about(num_envs=10**9),
    "envs as text": about(num_envs="2"),
    "fewer joints": about(joints=["a"]),
    "a randomization without episodes": about(randomization={}),
    "no integral": array("controller.integral", None),
    "no start": array("containment.start_qvel", None),
    "no state": array("engine", None),
    "an unknown array": array("more", lambda rows: np.zeros(1)),
    "an unknown leaf": array("containment.x", lambda rows: np.zeros(2)),
    "text": array("engine", lambda rows: rows.astype("U8")),
    "another precision": array("engine", np.float32),
    "another precision of the law": array("controller.integral", np.float32),
    "rows of another rank": array("engine", lambda rows: rows[:, 0]),
    "one env": array("engine", lambda rows: rows[:1]),
    "short rows": array("engine", lambda rows: rows[:, :-1]),
    "long rows": array("engine", lambda rows: np.pad(rows, ((0, 0), (0, 1)))),
    "efforts of one env": array("effort", lambda rows: rows[:1]),
    "flat efforts": array("effort", np.ravel),
    "a joint beyond": array("containment.joint", lambda rows: rows + ARM.dof),
    "a negative joint": array("containment.joint", lambda rows: rows - 1),
    "a cause beyond": array("containment.cause", lambda rows: rows + 99),
    "gains that are not numbers": array("params.kp", lambda rows: rows * np.nan),
    "negative gains": array("params.kp", lambda rows: -rows),
    "whole gains": array("params.kp", lambda rows: rows.astype(int)),
    "gains as text": array("params.kp", lambda rows: np.array("x")),
    "a motion of one row": array("motion", lambda rows: rows[:1]),
    "a motion of another precision": array("motion", np.float32),
    "numbers in place of a choice": array(
        "params.integration", lambda rows: np.zeros((1, ARM.dof))
    ),
}


@pytest.fixture(scope="module")
def runner() -> Any:
    with make() as made:
        yield made


@pytest.mark.parametrize("name", DAMAGES)
def test_a_damaged_snapshot_is_refused_before_anything_changes(
    good: Path, runner: Runner, name: str, tmp_path: Path
) -> None:
    runner.restore(Snapshot.load(write(tmp_path / "rewritten.npz", *read(good))))
    parts, before = read(good), runner.observe()
    DAMAGES[name](*parts)
    with pytest.raises(InvalidArgumentError) as caught:
        runner.restore(Snapshot.load(write(tmp_path / "bad.npz", *parts)))
    assert caught.value.argument in ("path", "snapshot")
    assert_identical(before, runner.observe())
    assert runner.step(GOAL).ok.all()


class Counts:
    """Controller with a state: the number of its sim steps."""

    def init(self, robot: Any, num_envs: int) -> Any:
        return {"steps": np.zeros(num_envs)}

    def __call__(self, state: Any, setpoint: Any, qpos: Any, qvel: Any, passive: Any) -> Any:
        return {"steps": state["steps"] + 1}, passive + 0.1 * state["steps"][:, None]


@pytest.mark.parametrize(
    "options",
    [
        {"control": Counts()},
        {"actuators": bp.make_actuators(ARM.dof, command_delay=2e-3)},
        {"actuators": bp.make_actuators(ARM.dof, sensor_delay=np.full((3, ARM.dof), 2e-3))},
        {"contacts": ["hand"], "guard": True},
    ],
    ids=label,
)
def test_a_file_holds_the_state_of_every_part(options: Any, tmp_path: Path) -> None:
    setpoint = np.outer([1, 2, 3], np.full(ARM.dof, 0.1))
    with Runner(ARM, 3, workers=0, **options) as runner:
        runner.step(setpoint)
        runner.snapshot().save(tmp_path / "s.npz")
        expected = runner.step(setpoint)
        runner.restore(Snapshot.load(tmp_path / "s.npz"))
        assert_identical(runner.step(setpoint), expected)
        head, tables = read(tmp_path / "s.npz")
        for name, rows in tables.items():
            if name.partition(".")[0] in (
                "controller",
                "actuators",
                "guard",
                "sensors",
            ) and rows.shape[:1] == (3,):
                with pytest.raises(InvalidArgumentError):
                    runner.restore(
                        Snapshot.load(write(tmp_path / "bad.npz", head, tables | {name: rows[:2]}))
                    )


@pytest.mark.parametrize(
    "damage",
    [
        array("episodes", lambda rows: rows[:1]),
        array("episodes", lambda rows: rows.astype(float)),
        array("episodes", lambda rows: rows - 9),
        array("episodes", None),
    ],
)
def test_episodes_that_do_not_agree_are_refused(damage: Any, tmp_path: Path) -> None:
    path = tmp_path / "drawn.npz"
    with make(randomization=Randomization(payload=Uniform(0, 0.5)), params=None) as runner:
        runner.snapshot().save(path)
        parts = read(path)
        runner.restore(Snapshot.load(write(path, *parts)))
        damage(*parts)
        with pytest.raises(InvalidArgumentError):
            runner.restore(Snapshot.load(write(path, *parts)))


def tables(snapshot: Snapshot) -> dict[str, Any]:
    """Return everything in a snapshot by name, as arrays and text."""
    found = {f"params.{name}": leaf for name, leaf in snapshot.params._asdict().items()}
    for name, rows in vars(snapshot.states).items():
        found |= (
            {f"{name}.{leaf}": each for leaf, each in rows.items()}
            if isinstance(rows, dict)
            else {name: rows}
        )
    found |= {"about": snapshot.about, "steps": snapshot.steps}
    return {
        name: value if isinstance(value, np.ndarray) else repr(value)
        for name, value in found.items()
    }


def check(path: Path, content: bytes, original: Snapshot) -> None:
    """Load ``content``: it is refused with our error, or equal to the original, with little
    memory.
    """
    path.write_bytes(content)
    tracemalloc.start()
    try:
        loaded = tables(Snapshot.load(path))
    except InvalidArgumentError:
        return
    finally:
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert peak < 50e6
    expected = tables(original)
    assert loaded.keys() == expected.keys()
    for name, value in expected.items():
        np.testing.assert_array_equal(loaded[name], value, err_msg=name)


@pytest.mark.parametrize("count", [60, pytest.param(4000, marks=pytest.mark.slow)])
def test_flipped_bits(good: Path, count: int, tmp_path: Path) -> None:
    whole, original, random = good.read_bytes(), Snapshot.load(good), np.random.default_rng(count)
    directory = whole.index(b"PK\x01\x02")
    for number in range(count):
        data = bytearray(whole)
        # Every second one hits the directory, which has no checksum.
        data[random.integers(directory if number % 2 else 0, len(data))] ^= 1 << random.integers(8)
        check(tmp_path / "flipped.npz", data, original)


EXTREMES = (np.nan, np.inf, -np.inf, 0.0, 1e38, -1e38, 1e-45, -1.0, 2.0**31 - 1)


@pytest.mark.parametrize("count", [20, pytest.param(1000, marks=pytest.mark.slow)])
def test_edits_under_right_checksums_are_refused_or_another_state(
    good: Path, count: int, tmp_path: Path
) -> None:
    random, restored = np.random.default_rng(count), 0
    head, original = read(good)
    with make() as runner, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for _ in range(count):
            arrays = {name: rows.copy() for name, rows in original.items()}
            for name in random.choice(sorted(arrays), random.integers(1, 4)):
                rows, kind = arrays[name], random.integers(6)
                if kind < 3 and rows.size:
                    rows.flat[random.integers(rows.size)] = np.array(
                        random.choice(EXTREMES)
                    ).astype(rows.dtype)
                elif kind == 3:
                    arrays[name] = rows.astype(random.choice(["f8", "f4", "i8", "?", "U4"]))
                elif kind == 4:
                    arrays[name] = rows.reshape(-1)[: random.integers(rows.size + 1)]
                else:
                    arrays[name] = np.repeat(rows, 2, axis=-1)
            try:
                runner.restore(Snapshot.load(write(tmp_path / "edited.npz", head, arrays)))
            except BatchPIDError:
                continue
            runner.step(GOAL)
            restored += 1
        assert 0 < restored < count
        runner.restore(Snapshot.load(good))
        assert runner.step(GOAL).ok.all()


def test_files_cut_short_or_with_more_at_their_end(good: Path, tmp_path: Path) -> None:
    whole, original = good.read_bytes(), Snapshot.load(good)
    for length in np.linspace(0, len(whole) - 1, 30).astype(int):
        check(tmp_path / "cut.npz", whole[:length], original)
    check(tmp_path / "long.npz", whole + bytes(1000), original)
    check(tmp_path / "shifted.npz", bytes(1000) + whole, original)


def test_what_is_no_snapshot_is_refused_and_not_executed(good: Path, tmp_path: Path) -> None:
    class Evil:
        def __reduce__(self) -> Any:
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


def test_a_bundled_robot_does_not_take_the_snapshot_of_another(good: Path) -> None:
    with Runner(load_bundled("panda"), N, workers=0) as other, pytest.raises(InvalidArgumentError):
        other.restore(Snapshot.load(good))
