"""A digest is equal for equal content, and differs for content that differs in any part."""

from __future__ import annotations

import subprocess
import sys
from collections import OrderedDict
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pytest

import batchpid as bp
from batchpid.arrays.array_types import CHOICE_TYPES, Clamp, Conditional
from batchpid.arrays.trees import digest


class Pair(NamedTuple):
    first: Any
    second: Any = None


class Other(NamedTuple):
    first: Any
    second: Any = None


@dataclass(frozen=True, eq=False)
class Record:
    first: Any
    second: Any = None


def test_memory_layout_and_byte_order_do_not_matter():
    table = np.arange(12.0).reshape(3, 4)
    apart = np.zeros((6, 8))
    apart[::2, ::2] = table
    same = [np.asfortranarray(table), apart[::2, ::2], table.astype(">f8"), table[::-1][::-1]]
    assert {digest(each) for each in same} == {digest(table)}
    different = [
        table.T,
        table.ravel(),
        table[None],
        table.astype(np.float32),
        table.astype(int),
        table.tolist(),
    ]
    assert len({digest(each) for each in [table, *different]}) == 7


def test_order_matters_in_sequences_alone():
    assert digest({"a": 1, "b": 2}) == digest(OrderedDict(b=2, a=1))
    assert digest({"a", "b"}) == digest(frozenset(("b", "a")))
    assert digest([1, 2]) == digest((1, 2)) != digest([2, 1])


def test_values_do_not_run_into_each_other():
    texts = [
        ("ab", "c"),
        ("a", "bc"),
        (["ab"], "c"),
        ([], "ab", "c"),
        ("ab", None, "c"),
        (b"ab", "c"),
        ({"ab": "c"},),
    ]
    parts = [(Pair("ab", "c"),), (Other("ab", "c"),), (Record("ab", "c"),)]
    nested = [("1",), (b"1",), ([],), ({},), ([[1], 2],), ([1, [2]],)]
    alike = [*texts, *parts, *nested, (1,), (1.0,), (True,), (0.0,), (-0.0,), (None,), ()]
    assert len({digest(*values) for values in alike}) == len(alike)


@pytest.mark.parametrize(
    "value", [object(), len, np.array([object()]), np.zeros(2, "f8, f4"), np.longdouble(1), int]
)
def test_what_may_hide_content_is_refused(value):
    with pytest.raises(bp.InvalidArgumentError, match="no digest"):
        digest({"k": [1, value]})


def test_arrays_of_jax_have_the_digest_of_their_content():
    jax = pytest.importorskip("jax")
    assert digest(jax.numpy.arange(3)) == digest(np.asarray(jax.numpy.arange(3)))


def test_choices_equal_those_of_their_type_alone():
    """Empty tuples are equal to each other: a cache would take one choice for another."""
    choices = [kind() for kind in CHOICE_TYPES]
    assert len(set(choices)) == len({digest(each) for each in choices}) == len(choices)
    assert Clamp() == Clamp() != Conditional() != ()


def test_digests_are_the_same_in_another_process():
    make = "bp.make_params(2, [3.0, 1.0], anti_windup='conditional'), {'b': {'x', 'y', 'z'}, 'a': None}"
    program = (
        f"import batchpid as bp; from batchpid.arrays.trees import digest; print(digest({make}))"
    )
    environment = {"PYTHONPATH": ":".join(filter(None, sys.path)), "PYTHONHASHSEED": "7"}
    out = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True
    )
    assert out.stdout.split() == [digest(*eval(f"({make})"))]
