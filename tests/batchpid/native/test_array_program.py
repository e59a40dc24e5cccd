"""Programs of array functions give the bytes of NumPy, for all shapes of inputs and any number of
threads.
"""

from contextlib import contextmanager
from unittest import mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from native_cases import bits, numbers

from batchpid.arrays.elementwise import (
    matrix_vector,
    push_history,
    row_minimum,
    take_columns,
    take_rows,
)
from batchpid.motors import delay
from batchpid.native import array_program
from batchpid.native.array_program import ArrayProgram, obstacle
from batchpid.native.extensions import OPERATIONS
from batchpid.native.tracing import Namespace, Symbol, trace

pytestmark = pytest.mark.skipif(bool(obstacle()), reason="there are no native programs")
DTYPES = st.sampled_from([np.float64, np.float32])
SHAPES = st.tuples(st.sampled_from([1, 3, 64, 250]), st.sampled_from([1, 2, 7, 9, 16, 33, 100]))


@contextmanager
def on_cores(count):
    """Make programs of small arrays for ``count`` threads."""
    cores = mock.patch.object(array_program.os, "sched_getaffinity", return_value=range(count))
    with cores, mock.patch.object(array_program, "NUMBERS_PER_THREAD", 64):
        yield


def assert_identical(ours, theirs):
    for mine, expected in zip(ours, theirs, strict=True):
        assert bits(mine) == bits(np.broadcast_to(expected, mine.shape))


def every_operation(a, b, c, matrix):
    """Apply all operations of programs to arrays (rows, columns) and a matrix for each row; return
    the results.
    """
    xp = a.__array_namespace__()
    masks = a > b, a >= b, a < b, a <= b, a == b, a != b, xp.isfinite(a)
    some = (a > b) & (b < c), (a > b) | (b < c), ~(a > b)
    numbers = (
        a + b,
        a - b,
        a * b,
        a / b,
        -a,
        abs(a),
        xp.rint(a),
        xp.ceil(a),
        xp.floor(a),
        xp.sqrt(a),
        xp.sign(a),
    )
    pairs = a * b + c, a + b * c, a + b - c, (a - b) * c, xp.minimum(xp.maximum(a, b), c)
    ends = xp.maximum(a, b), xp.minimum(a, b), xp.maximum(b, a), xp.minimum(b, a)
    across = xp.zeros_like(a) + row_minimum(a), matrix_vector(matrix, b)
    return [*numbers, *pairs, *ends, xp.where(a > b, b, c), *across, *masks, *some]


def history_operations(rows, history, a):
    """Push ``a`` to ``history``; return its numbers in the samples ``rows`` (rows, columns)."""
    return [take_rows(push_history(history, a), rows)]


def columns_of(columns, a, b):
    """Return the columns ``columns`` (columns,) of ``a``, and of a mask."""
    return [take_columns(a, columns), take_columns(a > b, columns)]


@given(SHAPES, DTYPES, st.integers(0, 2**32), st.data())
@settings(max_examples=25)
def test_every_operation_on_inputs_of_every_shape(shape, dtype, seed, data):
    rng, (rows, columns) = np.random.default_rng(seed), shape
    shapes = st.sampled_from([shape, (1, columns), (rows, 1), (1, 1)])
    inputs = [
        numbers(rng, shape, 0.2, dtype),
        *(numbers(rng, data.draw(shapes), 0.2, dtype) for _ in range(2)),
    ]
    inputs.append(numbers(rng, (*shape, columns), 0.01, dtype))
    wide = [*np.broadcast_arrays(*inputs[:3]), inputs[3]]
    with on_cores(data.draw(st.integers(1, 4))):
        program = ArrayProgram(trace(every_operation, 0, 4, dtype), (), 4, shape, dtype)
    with np.errstate(all="ignore"):
        assert_identical(program(*inputs), every_operation(*wide))


def test_histories_rows_and_columns():
    rng, shape = np.random.default_rng(0), (5, 9)
    a, b, history = *rng.normal(size=(2, *shape)), rng.normal(size=(5, 4, 9))
    rows, columns = rng.uniform(-2, 6, shape), rng.integers(9, size=9)
    # Rows beyond the history are its first and last one.
    expected = history_operations(np.clip(rows, 0, 3), history, a)
    traced = trace(history_operations, 1, 2)
    assert_identical(ArrayProgram(traced, [rows], 2, shape)(history, a), expected)
    found = ArrayProgram(trace(columns_of, 1, 2), [columns], 2, shape)(a, b)
    assert_identical(found, columns_of(columns, a, b))


def functions_of_the_c_library(a):
    xp = a.__array_namespace__()
    return [xp.exp(a), xp.tanh(a), xp.sin(a)]


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_functions_of_the_c_library_are_within_four_units_of_numpy_wherever_a_number_stands(dtype):
    rng = np.random.default_rng(1)
    rows = numbers(rng, (5000, 7), 0.1, dtype)
    program = ArrayProgram(trace(functions_of_the_c_library, 0, 1, dtype), (), 1, rows.shape, dtype)
    found = program(rows)
    with np.errstate(all="ignore"):
        expected = functions_of_the_c_library(rows)
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_array_max_ulp(ours, theirs, 4)
    alone = ArrayProgram(trace(functions_of_the_c_library, 0, 1, dtype), (), 1, (1, 7), dtype)
    assert_identical(alone(rows[4321:4322].copy()), [table[4321:4322] for table in found])


def test_no_operation_is_left_out():
    namespace = Namespace()
    functions_of_the_c_library(Symbol(namespace))
    every_operation(*(Symbol(namespace) for _ in range(4)))
    history_operations(*(Symbol(namespace) for _ in range(3)))
    columns_of(*(Symbol(namespace) for _ in range(3)))
    noted = {name for name, _, _ in namespace.noted}
    numbers = np.frombuffer(trace(every_operation, 0, 4).operations, np.int32).reshape(-1, 5)[:, 0]
    assert noted | {OPERATIONS[number] for number in numbers} == set(OPERATIONS)


@given(SHAPES, DTYPES, st.integers(0, 2**32), st.data())
@settings(max_examples=25)
def test_constants_of_one_row_of_all_rows_and_numbers(shape, dtype, seed, data):
    def function(k, high, x):
        xp = x.__array_namespace__()
        return [xp.minimum(k * x + (1 - k), high), -k < x, k + -0.0]

    rng = np.random.default_rng(seed)
    shapes = st.sampled_from([shape, (1, shape[1]), ()])
    k, high = (np.asarray(numbers(rng, data.draw(shapes), 0.2, dtype)) for _ in range(2))
    x = numbers(rng, shape, 0.2, dtype)
    program = ArrayProgram(trace(function, 2, 1, dtype), [k, high], 1, shape, dtype)
    out = [x, np.empty(shape, bool), np.empty(shape, dtype)]
    with np.errstate(all="ignore"):
        expected = function(k.reshape(k.shape or (1, 1)), high, x.copy())
    assert program(x, out=out) is out
    assert_identical(out, expected)


def test_arrays_that_do_not_fit_are_refused():
    program = ArrayProgram(trace(lambda a, b: [a + b, a > b], 0, 2), (), 2, (4, 3))
    a, b, masks = np.ones((4, 3)), np.ones((4, 3)), np.empty((4, 3), bool)
    rows = np.ones((5, 3))
    for inputs, out in (
        ((a,), None),
        ((a, b.astype(np.float32)), None),
        ((a, b[:2]), None),
        ((a, b), [a]),
        ((a, b), [np.empty((4, 3), np.float32), masks]),
        ((a, b), [np.empty((3, 4)).T, masks]),
        ((a, b), [np.broadcast_to(1.0, (4, 3)), masks]),
        ((rows[1:], b), [rows[:-1], masks]),
    ):
        with pytest.raises(ValueError, match="do not fit"):
            program(*inputs, out=out)
    assert program(a, b, out=[a, masks])[0] is a
    assert (a == 2).all()


def test_results_may_be_written_over_inputs_that_are_read_later():
    def swap(a, b):
        total = a + b
        return [total - a, b - 1.0 + a, total]

    a, b = np.random.default_rng(0).normal(size=(2, 700, 9))
    out = [a.copy(), b.copy(), np.empty_like(a)]
    ArrayProgram(trace(swap, 0, 2), (), 2, a.shape)(*out[:2], out=out)
    assert_identical(out, swap(a, b))


@given(SHAPES, st.integers(2, 40), st.integers(0, 2**32), st.integers(1, 4))
@settings(max_examples=25)
def test_histories_are_changed_in_place(shape, samples, seed, threads):
    rng, (rows, columns) = np.random.default_rng(seed), shape
    history = rng.normal(size=(rows, samples, columns))
    late = delay.discretise(rng.uniform(0, samples, shape), 1.0, samples)

    def function(whole, fraction, held, value):
        xp = value.__array_namespace__()
        return [delay.read(push_history(held, value), (whole, fraction), None, xp)]

    with on_cores(threads):
        program = ArrayProgram(trace(function, 2, 2), late, 2, shape)
    ours, theirs = history.copy(), history
    for _ in range(3):
        value = rng.normal(size=shape)
        theirs = push_history(theirs, value)
        assert_identical(program(ours, value), [delay.read(theirs, late, None, np)])
        assert_identical([ours], [theirs])


def test_histories_that_do_not_fit_are_refused():
    rows, history, value = np.zeros((4, 3)), np.zeros((4, 5, 3)), np.ones((4, 3))
    program = ArrayProgram(trace(history_operations, 1, 2), [rows], 2, value.shape)
    program(history, value)
    assert (history[:, 0] == 1).all()
    assert not history[:, 1:].any()
    fixed = history.copy()
    fixed.setflags(write=False)
    for inputs in (
        *((wrong, value) for wrong in (fixed, history[:, :, :2].copy(), history[:3], value)),
        (history, history.ravel()[:12].reshape(4, 3)),
    ):
        with pytest.raises(ValueError, match="do not fit"):
            program(*inputs)


# -- Traces
# --------------------------------------------------------------------------------------------------


def test_an_operation_that_programs_do_not_have_is_an_error():
    with pytest.raises(AttributeError, match="no operation 'arctan'"):
        trace(lambda a: [a.__array_namespace__().arctan(a)], 0, 1)


def test_a_branch_on_entries_cannot_be_traced():
    with pytest.raises(TypeError, match="branch on the entries"):
        trace(lambda x: [x if x > 0 else -x], 0, 1)


def test_a_scalar_that_would_widen_the_result_is_refused():
    assert trace(lambda x: [x * np.float32(2)], 0, 1).literals == (2.0,)
    assert trace(lambda x: [x * 0.1], 0, 1, np.float32).literals == (0.1,)
    with pytest.raises(TypeError, match="float64"):
        trace(lambda x: [x * np.float64(2)], 0, 1, np.float32)
