"""Texts of params that are damaged or made to do harm: refused with our error, or other valid params, checked."""

import json
import time
import tracemalloc

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

import batchpid as bp

NAMES = ["shoulder", "elbow"]
PARAMS = bp.make_params(
    2, [[40.0, 20.0], [30.0, 10.0]], ki=5.0, kd=2.0, effort_limit=87.0, anti_windup=["conditional", "none"]
)


def check(text):
    """Read ``text``: it is refused with our error, or it holds valid params, soon and with little memory."""
    tracemalloc.start()
    start = time.process_time()
    try:
        params, names = bp.loads_params(text)
    except bp.InvalidArgumentError:
        pass
    else:
        params.check(params.num_envs, names)
        assert bp.loads_params(bp.dumps_params(params, names))[1] == names
    finally:
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert time.process_time() - start < 5.0
    assert peak < 20e6


def flips(folder, suffix, count, seed):
    whole, random = bp.dumps_params(PARAMS, NAMES, format=suffix).encode(), np.random.default_rng(seed)
    path = folder / f"params.{suffix}"
    for _ in range(count):
        data = bytearray(whole)
        data[random.integers(len(data))] ^= 1 << random.integers(8)
        path.write_bytes(data)
        try:
            params, names = bp.load_params(path)
        except bp.InvalidArgumentError:
            continue
        params.check(params.num_envs, names)
        check(data.decode())


@pytest.mark.parametrize("suffix", ["yaml", "json"])
def test_40_flipped_bits(suffix, tmp_path):
    flips(tmp_path, suffix, 40, seed=0)


@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["yaml", "json"])
def test_1000_flipped_bits(suffix, tmp_path):
    flips(tmp_path, suffix, 1000, seed=1)


@pytest.mark.parametrize("suffix", ["yaml", "json"])
def test_texts_cut_short(suffix):
    whole = bp.dumps_params(PARAMS, NAMES, format=suffix)
    for length in range(0, len(whole), 29):
        check(whole[:length])


ODD = st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5) | st.sampled_from([10**400, "inf"])
VALUES = ODD | st.lists(ODD, max_size=3) | st.dictionaries(st.text(max_size=2), ODD, max_size=2)
OPTIONS = st.sampled_from(bp.PIDParams._fields)
DOCUMENTS = st.fixed_dictionaries(
    {
        "format": st.just("batchpid-params-1") | VALUES,
        "joints": VALUES
        | st.dictionaries(
            st.sampled_from(NAMES) | st.text(max_size=3),
            VALUES | st.dictionaries(OPTIONS, VALUES, max_size=4).map(lambda some: {"kp": 1.0} | some),
            max_size=3,
        ),
    },
    optional={
        "dtype": st.sampled_from(["float32", "float64"]) | VALUES,
        "gain_units": st.sampled_from(["effort", "inertia"]) | VALUES,
        "about": VALUES,
        "more": VALUES,
    },
)


@settings(max_examples=12)
@given(DOCUMENTS)
def test_any_document_is_refused_or_valid(document):
    check(json.dumps(document))
    check(yaml.safe_dump(document))


@settings(max_examples=25)
@given(st.text(st.characters(codec="utf-8") | st.sampled_from("[]{}:,-?!&*|>'\"%@#\n "), max_size=60))
def test_any_text_is_refused(text):
    with pytest.raises(bp.InvalidArgumentError):
        bp.loads_params(text)


@pytest.mark.parametrize(
    "value",
    [
        *('!!int ""', "!!int _", "!!float _", "!!bool x", "!!timestamp x", "!!binary '=='", "!!omap [a]", "!!merge x"),
        *("2001-13-45", "1e999", "1" + "0" * 5000, ".nan", "{<<: 1}", "!!python/object/apply:os.abort []"),
        pytest.param("[" * 2_000, marks=pytest.mark.slow),
        *("{a: " * 2_000, "- " * 2_000, "? " * 2_000, "'" + "a\n" * 2_000, "!" * 2_000, "\x00"),
    ],
)
def test_values_that_the_parser_trips_over_are_refused(value):
    with pytest.raises(bp.InvalidArgumentError):
        bp.loads_params(f"format: batchpid-params-1\njoints:\n  a:\n    kp: {value}\n")


def test_files_that_cannot_be_opened_are_named(tmp_path):
    (tmp_path / "folder.yaml").mkdir()
    for name in ("folder.yaml", "x" * 5000 + ".yaml"):
        with pytest.raises(bp.InvalidArgumentError, match="cannot be read"):
            bp.load_params(tmp_path / name)
    with pytest.raises(FileNotFoundError):
        bp.load_params(tmp_path / "nothing.yaml")
