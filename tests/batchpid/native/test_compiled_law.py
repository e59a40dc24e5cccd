"""BatchPID by the native extension: the bytes of NumPy for all options, inputs, shapes and numbers
of threads.
"""

from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from law_cases import generated_options
from native_cases import bits, numbers

import batchpid as bp
from batchpid.errors import InvalidArgumentError
from batchpid.native import array_program, extensions
from batchpid.native.compiled import header, law_segments
from batchpid.stages import control_segments

NATIVE = bp.BatchPID(bp.make_params(1, 1.0), 1, 0.01).native
needs_extension = pytest.mark.skipif(not NATIVE, reason="there are no native programs")
DT = 1 / 2000
EVERYTHING = {
    "kp": 40.0,
    "ki": 5.0,
    "kd": 2.0,
    "effort_limit": 87.0,
    "derivative_filter_time": 0.01,
    "anti_windup": "back_calculation",
}


def in_numpy(*arguments, **options):
    """Return a controller that NumPy computes."""
    with mock.patch.dict("os.environ", {"BATCHPID_NATIVE": "0"}):
        return bp.BatchPID(*arguments, **options)


@needs_extension
@given(
    st.sampled_from([1, 2, 7, 8, 9, 20, 130]),
    st.sampled_from([1, 2, 5, 57, 120, 300]),
    st.sampled_from([np.float64, np.float32]),
    st.sampled_from([0.0, 0.1]),
    st.integers(0, 2**32),
    st.data(),
)
def test_a_native_controller_is_bit_identical_to_numpy(joints, envs, dtype, odd, seed, data):
    rng, shape = np.random.default_rng(seed), (envs, joints)
    options = generated_options(seed, data.draw(st.sampled_from([1, envs]), "envs"), joints)
    params = bp.make_params(joints, **options, dtype=dtype)
    setpoint_shape = data.draw(
        st.sampled_from([shape, (1, joints), (joints,), (envs, 1), ()]), "setpoint"
    )
    present = data.draw(st.tuples(*[st.booleans()] * 3), "optional inputs")
    ours = bp.BatchPID(params, envs, DT)
    theirs = in_numpy(params, envs, DT)
    for step in range(4):
        r, y = numbers(rng, setpoint_shape, odd, dtype), numbers(rng, shape, odd, dtype)
        rest = [numbers(rng, shape, odd, dtype) if one else None for one in present]
        with np.errstate(all="ignore"):
            expected = theirs(r, y, *rest)
        out = data.draw(st.sampled_from([None, np.empty(shape, dtype), y]), "out")
        found = ours(r, y, *rest, out=out)
        assert out is None or found is out
        assert bits(found) == bits(expected)
        if step % 2:
            assert [*map(bits, ours.state)] == [*map(bits, theirs.state)]


@needs_extension
@pytest.mark.parametrize("threads", [1, 2, 3])
def test_threads_of_a_large_batch_give_the_bytes_of_numpy(threads, monkeypatch):
    monkeypatch.setattr(array_program.os, "sched_getaffinity", lambda _: range(threads))
    params, rng = bp.make_params(9, **EVERYTHING), np.random.default_rng(0)
    shape = 60_001, 9  # numbers of four threads
    ours, theirs = bp.BatchPID(params, shape[0], DT), in_numpy(params, shape[0], DT)
    for _ in range(2):
        y = rng.normal(size=shape)
        np.testing.assert_array_equal(ours(1.0, y), theirs(1.0, y))


def both(options=EVERYTHING, envs=5, joints=3):
    params = bp.make_params(joints, **options)
    return (
        bp.BatchPID(params, envs, DT),
        in_numpy(params, envs, DT),
        np.random.default_rng(0).normal(size=(9, envs, 3)),
    )


@needs_extension
def test_a_controller_says_whether_it_is_native():
    ours, theirs, _ = both()
    assert (ours.native, theirs.native) == (True, False)


@pytest.mark.parametrize(
    "change",
    [
        np.asfortranarray,
        lambda rows: rows.astype(np.float32).astype(rows.dtype.newbyteorder()),
        lambda rows: (
            np.frombuffer(b"...." + rows.tobytes(), np.uint8)[4:].view(float).reshape(rows.shape)
        ),
        lambda rows: rows.view(np.recarray),
        lambda rows: rows.tolist(),
    ],
    ids=["columns first", "byte order", "unaligned", "a subclass", "lists"],
)
def test_inputs_may_be_any_arrays(change):
    ours, theirs, y = both()
    for step in range(4):
        one = change(np.float32(y[step]).astype(float))
        np.testing.assert_array_equal(
            ours(y[8], one, feedforward=one), theirs(y[8], one, feedforward=one)
        )


def test_out_may_be_an_input_or_overlap_with_one():
    ours, theirs, y = both()
    for step in range(4):
        expected = theirs(y[8], y[step])
        np.testing.assert_array_equal(ours(y[8], y[step], out=y[step]), expected)
        rows = np.concatenate([y[7, :1], y[7]])
        expected = theirs(rows[1:].copy(), y[6])
        assert np.shares_memory(ours(rows[1:], y[6], out=rows[:-1]), rows)
        np.testing.assert_array_equal(rows[:-1], expected)


@pytest.mark.parametrize(
    "out",
    [
        np.zeros((5, 3), np.float32),
        np.zeros((3, 5)),
        np.zeros((3, 5)).T,
        np.broadcast_to(0.0, (5, 3)),
        [[0.0] * 3] * 5,
    ],
    ids=["dtype", "shape", "order", "read-only", "list"],
)
def test_a_wrong_out_is_refused_and_changes_nothing(out):
    for pid in both()[:2]:
        y = np.ones((5, 3))
        pid(2.0, y)
        before = pid.state
        for _ in range(2):  # before and after a fast call
            with pytest.raises(InvalidArgumentError, match="out: must be a contiguous"):
                pid(2.0, y, out=out)
            np.testing.assert_array_equal(pid.state.integral, before.integral)
            pid(2.0, y)
            before = pid.state


def test_out_is_for_numpy():
    pytest.importorskip("jax")
    pid = bp.BatchPID(bp.make_params(3, 1.0, dtype=np.float32), 5, DT, "jax")
    with pytest.raises(InvalidArgumentError, match="for backend 'numpy' alone"):
        pid(1.0, np.zeros((5, 3)), out=np.zeros((5, 3), np.float32))


@needs_extension
def test_the_commonest_laws_are_one_pass_and_compiled():
    """Each has one segment of all its operations, and the extensions were built from these, and
    from those of the commonest control loops.
    """
    found = list(law_segments())
    assert found
    assert {segment.first for segment in found} == {0}
    texts = {
        "batchpid/native/passes.h": header(found, ("float", "double")),
        "sim/engine/native/passes.h": header(control_segments(), ("double",)),
    }
    for name, text in texts.items():
        file = Path(extensions.ROOT) / name
        assert not file.is_file() or file.read_text() == text


@needs_extension
def test_efforts_that_somebody_holds_keep_their_values():
    """Large efforts that nobody holds are written again; a view of an array holds it."""
    envs = 2**16
    pid = bp.BatchPID(bp.make_params(9, **EVERYTHING), envs, DT)
    measurement = np.zeros((envs, 9))
    setpoints = [np.full((envs, 9), float(number)) for number in range(6)]
    views, copies = [], []
    for number, setpoint in enumerate(setpoints):
        effort = pid(setpoint, measurement)
        copies.append(effort.copy())
        views.append(effort[:1] if number % 2 == 0 else effort)
    for view, copied in zip(views, copies, strict=True):
        np.testing.assert_array_equal(view, copied[: len(view)])
