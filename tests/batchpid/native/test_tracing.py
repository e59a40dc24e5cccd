"""Traces of functions of arrays."""

from __future__ import annotations

import numpy as np
import pytest

from batchpid.native.symbols import Namespace
from batchpid.native.tracing import trace


def test_an_operation_that_programs_do_not_have_is_an_error():
    with pytest.raises(AttributeError, match="no operation 'arctan'"):
        trace(lambda a: [a.__array_namespace__().arctan(a)], 0, 1)


def test_a_trace_holds_what_its_results_need_and_no_more():
    def function(a, b):
        unused = a * b
        assert isinstance(unused.__array_namespace__(), Namespace)
        return [a - b, b]

    noted = trace(function, 1, 1)
    assert len(noted.operations) == 5 * 4
    assert np.frombuffer(noted.results, np.int32).tolist() == [2, 1]
    assert noted.literals == ()


def test_literals_of_a_trace_keep_their_sign():
    assert [repr(number) for number in trace(lambda x: [x + 0.0, x + -0.0, x + 0.0], 0, 1).literals] == ["0.0", "-0.0"]


def test_what_depends_on_constants_alone_is_a_prelude():
    traced = trace(lambda k, x: [x * (1 - k) > 0.5], 1, 1)
    assert len(traced.operations) == 5 * 4 * 2
    assert len(traced.prelude.operations) == 5 * 4
    assert traced.prelude.literals == ()
    assert traced.masks == (True,)


def test_a_branch_on_entries_cannot_be_traced():
    with pytest.raises(TypeError, match="depend on the entries"):
        trace(lambda x: [x if x > 0 else -x], 0, 1)


def test_a_scalar_that_would_widen_the_result_is_refused():
    assert trace(lambda x: [x * np.float32(2)], 0, 1).literals == (2.0,)
    assert trace(lambda x: [x * 0.1], 0, 1, np.float32).literals == (0.1,)
    with pytest.raises(TypeError, match="float64"):
        trace(lambda x: [x * np.float64(2)], 0, 1, np.float32)


def test_pairs_of_operations_are_one_where_nothing_else_needs_the_first():
    def count(function):
        return len(trace(function, 0, 3).operations) // (5 * 4)

    assert count(lambda a, b, c: [a * b + c]) == count(lambda a, b, c: [c + a * b]) == 1
    assert count(lambda a, b, c: [a * b - c]) == 2

    def both(a, b, c):
        product = a * b
        return [product + c, product]

    assert count(both) == 2
