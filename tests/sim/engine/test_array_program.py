"""Traces of functions of arrays."""

from __future__ import annotations

import numpy as np
import pytest

from sim.engine.array_program import Namespace, trace


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
