"""Snapshots with flipped bits, cut short, or made to do harm: refused with our error, or equal to the original."""

import json
import os
import time
import tracemalloc
import warnings

import numpy as np
import pytest

from batchpid.errors import BatchPIDError, InvalidArgumentError
from batchpid.sim import Randomization, Runner, Snapshot, Uniform


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    from robots import load_bundled

    panda = load_bundled("panda")
    path = tmp_path_factory.mktemp("snapshot") / "good.npz"
    with Runner(panda, 2, params=panda.params(anti_windup="back_calculation"), workers=0) as runner:
        runner.step(panda.settings.target)
        runner.snapshot().save(path)
    return path


def tables(snapshot):
    """Return every array of a snapshot by name, and the rest as text."""
    params = {f"params.{name}": leaf for name, leaf in snapshot.params._asdict().items()}
    states = vars(snapshot.states)
    groups = {f"{name}.{leaf}": rows for name in ("controller", "containment") for leaf, rows in states[name].items()}
    arrays = {name: rows for name, rows in (params | states | groups).items() if isinstance(rows, np.ndarray)}
    rest = {name: repr(value) for name, value in params.items() if name not in arrays}
    return arrays, rest | {"about": repr(snapshot.about), "steps": snapshot.steps}


def check(path, content, original):
    """Load ``content``: it is refused with our error, or equal to the original, soon and with little memory."""
    path.write_bytes(content)
    tracemalloc.start()
    start = time.process_time()
    try:
        loaded = Snapshot.load(path)
    except InvalidArgumentError as error:
        assert "cannot be read as a snapshot" in str(error)  # noqa: PT017
    else:
        (arrays, rest), (ours, others) = tables(original), tables(loaded)
        assert rest == others
        assert arrays.keys() == ours.keys()
        for name, rows in arrays.items():
            np.testing.assert_array_equal(rows, ours[name], err_msg=name)
    finally:
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert time.process_time() - start < 5.0
    assert peak < 50e6


def flips(good, folder, count, seed):
    whole, original, random = good.read_bytes(), Snapshot.load(good), np.random.default_rng(seed)
    directory = whole.index(b"PK\x01\x02")
    for number in range(count):
        data = bytearray(whole)
        # Every second one hits the directory, which has no checksum.
        data[random.integers(directory if number % 2 else 0, len(data))] ^= 1 << random.integers(8)
        check(folder / "flipped.npz", data, original)


def test_60_flipped_bits(good, tmp_path):
    flips(good, tmp_path, 60, seed=0)


@pytest.mark.slow
def test_1000_flipped_bits_and_a_seventh_of_those_in_the_directory(good, tmp_path):
    flips(good, tmp_path, 1000, seed=1)
    whole, original = good.read_bytes(), Snapshot.load(good)
    for bit in range(8 * whole.index(b"PK\x01\x02"), 8 * len(whole), 7):
        data = bytearray(whole)
        data[bit // 8] ^= 1 << bit % 8
        check(tmp_path / "flipped.npz", data, original)


EXTREMES = (np.nan, np.inf, -np.inf, 0.0, 1e38, -1e38, 1e-45, -1.0, 2.0**31 - 1)


def edits(good, folder, count, seed):
    """Restore snapshots with other numbers, dtypes and shapes under right checksums: our error, or another state."""
    from robots import load_bundled

    panda, random = load_bundled("panda"), np.random.default_rng(seed)
    with np.load(good) as file:
        original = dict(file)
    names = sorted(original.keys() - {"head"})
    options = {"params": panda.params(), "workers": 0, "on_invalid_input": "contain"}
    restored = 0
    with Runner(panda, 2, **options) as runner, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for _ in range(count):
            arrays = {name: rows.copy() for name, rows in original.items()}
            for name in random.choice(names, random.integers(1, 4)):
                rows, kind = arrays[name], random.integers(6)
                if kind < 3 and rows.size:
                    value = np.array(random.choice(EXTREMES)).astype(rows.dtype)
                    rows.flat[random.integers(rows.size)] = value
                elif kind == 3:
                    arrays[name] = rows.astype(random.choice(["f8", "f4", "i8", "?", "U4"]))
                elif kind == 4:
                    arrays[name] = rows.reshape(-1)[: random.integers(rows.size + 1)]
                else:
                    arrays[name] = np.repeat(rows, 2, axis=-1)
            np.savez(folder / "edited.npz", **arrays)
            try:
                runner.restore(Snapshot.load(folder / "edited.npz"))
            except BatchPIDError:
                continue
            runner.step(panda.settings.target)
            restored += 1
        assert 0 < restored < count
        runner.restore(Snapshot.load(good))
        assert runner.step(panda.settings.target).ok.all()


def test_20_edits_under_right_checksums(good, tmp_path):
    edits(good, tmp_path, 20, seed=0)


@pytest.mark.slow
def test_1000_edits_under_right_checksums(good, tmp_path):
    edits(good, tmp_path, 1000, seed=1)


def test_files_cut_short_or_with_more_at_their_end(good, tmp_path):
    whole, original = good.read_bytes(), Snapshot.load(good)
    for length in np.linspace(0, len(whole) - 1, 30).astype(int):
        check(tmp_path / "cut.npz", whole[:length], original)
    check(tmp_path / "long.npz", whole + bytes(1000), original)
    check(tmp_path / "shifted.npz", bytes(1000) + whole, original)


def rewrite(good, path, save=np.savez, **changes):
    """Write the snapshot with other values in its head, or other arrays."""
    with np.load(good) as file:
        arrays = dict(file)
    head = json.loads(str(arrays.pop("head")))
    head |= changes.pop("head", {})
    head["about"] |= changes.pop("about", {})
    save(path, head=np.array(json.dumps(head)), **(arrays | changes))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"about": {"num_envs": 10**12}}, "num_envs: out of range"),
        ({"about": {"num_envs": 10**9}}, "do not fit 1000000000 envs"),
        ({"about": {"num_envs": "2"}}, "num_envs"),
        ({"about": {"joints": ["a"]}}, "do not fit 2 envs of 1 joints"),
        ({"effort": np.zeros(18, np.float32)}, "do not fit"),
        ({"engine": np.zeros((2, 10**5), np.float32)}, "has engine of"),
        ({"params.kp": np.full((1, 9), np.nan)}, r"params\.kp"),
        ({"params.kp": np.full((1, 9), -1.0)}, r"params\.kp"),
        ({"params.kp": np.zeros((1, 9), int)}, "int64"),
        ({"params.kp": np.array("x")}, "cannot be read"),
        ({"params.integration": np.zeros((1, 9))}, "cannot be read"),
        ({"head": {"markers": {"integration": "ZeroEffort"}}}, "ZeroEffort"),
        ({"head": {"markers": {"kp": "Everywhere"}}}, "kp"),
        ({"head": {"steps": 1.5}}, "steps"),
        ({"head": {"steps": 10**30}}, "steps"),
        ({"head": {"about": None}}, "cannot be read"),
    ],
)
def test_numbers_that_do_not_agree_are_refused(good, changes, message, tmp_path):
    changes = dict(changes)
    if changes.get("head", {}).get("about", 0) is None:
        with np.load(good) as file:
            np.savez(tmp_path / "bad.npz", **{**file, "head": np.array('{"format": 3, "about": null}')})
    else:
        rewrite(good, tmp_path / "bad.npz", **changes)
    with pytest.raises(InvalidArgumentError, match=message):
        Snapshot.load(tmp_path / "bad.npz")


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    """Snapshot of a runner with episodes and targets."""
    from robots import load_bundled

    path = tmp_path_factory.mktemp("snapshot") / "drawn.npz"
    options = {"setpoint_space": "tool", "tool": "panda_hand", "randomization": Randomization(payload=Uniform(0, 0.5))}
    with Runner(load_bundled("panda"), 2, workers=0, **options) as runner:
        runner.snapshot().save(path)
    return path


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"episodes": np.zeros((1, 2), np.int64)}, "not counts"),
        ({"episodes": np.zeros((2, 2))}, "not counts"),
        ({"episodes": np.full((2, 2), -1)}, "not counts"),
        ({"about": {"randomization": None}}, "episodes do not fit"),
        ({"targets": np.zeros((1, 9))}, "not positions"),
        ({"targets": np.full((2, 9), np.nan)}, "not positions"),
        ({"about": {"setpoint_space": "joints"}}, "targets do not fit"),
    ],
)
def test_episodes_and_targets_that_do_not_agree_are_refused(drawn, changes, message, tmp_path):
    assert Snapshot.load(drawn).episodes.shape == (2, 2)
    rewrite(drawn, tmp_path / "bad.npz", **changes)
    with pytest.raises(InvalidArgumentError, match=message):
        Snapshot.load(tmp_path / "bad.npz")


def test_a_small_file_that_expands_a_thousand_times_is_refused(good, tmp_path):
    rewrite(good, tmp_path / "bomb.npz", np.savez_compressed, engine=np.zeros((2, 10**7), np.float32))
    tracemalloc.start()
    with pytest.raises(InvalidArgumentError, match="bytes, more than"):
        Snapshot.load(tmp_path / "bomb.npz")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 2e6


def test_encrypted_files_folders_and_pipes_are_refused(good, tmp_path):
    data = bytearray(good.read_bytes())
    data[data.index(b"PK\x01\x02") + 8] |= 1
    (tmp_path / "encrypted.npz").write_bytes(data)
    os.mkfifo(tmp_path / "pipe")
    for name, message in (("encrypted.npz", "encrypted"), ("pipe", "no such file"), (".", "no such file")):
        with pytest.raises(InvalidArgumentError, match=message):
            Snapshot.load(tmp_path / name)
    with pytest.raises(InvalidArgumentError, match="cannot be read"):
        Snapshot.load("x" * 5000)


def test_a_table_of_another_precision_is_refused(good, tmp_path):
    with np.load(good) as file:
        tables = dict(file)
    for name in (each for each in tables if tables[each].dtype == np.float64 and each.startswith("controller")):
        np.savez(tmp_path / "edited.npz", **tables | {name: tables[name].astype(np.float32)})
        with pytest.raises(InvalidArgumentError, match=f"has {name} of float32"):
            Snapshot.load(tmp_path / "edited.npz")
