"""Files of options of operational-space control."""

from __future__ import annotations

import math

import numpy as np
import pytest
from trees import tree_of

import batchpid.task_space as ts
from batchpid.errors import InvalidArgumentError

OPTIONS = {
    "stiffness": [100.0, 200.0, 0.1, 4.0, 5.0, 6.0],
    "damping_ratio": 0.7,
    "position_error_limit": math.inf,
    "axes": [True, True, True, False, False, False],
    "frame": "tool",
}


@pytest.mark.parametrize("suffix", ["yaml", "json"])
def test_options_come_back_as_they_were(suffix, tmp_path):
    path = tmp_path / f"gains.{suffix}"
    ts.save_osc_options(path, OPTIONS | {"stiffness": np.array(OPTIONS["stiffness"])}, {"seed": 3})
    assert ts.load_osc_options(path) == OPTIONS
    ts.make_osc_params(tree_of("panda"), **ts.load_osc_options(path))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("format: batchpid-params-1", "format: is not that of gains for operational-space control"),
        ("[]", "format: is not"),
        ("format: batchpid-osc-1\nstifness: 3", "key: unknown option.*'stiffness'"),
        ("format: batchpid-osc-1\nstiffness: [a]", r"stiffness: is \['a'\]; give a number"),
        ("format: batchpid-osc-1\nstiffness: true", "stiffness: is True"),
        ("format: batchpid-osc-1\naxes: [1, 1]", "axes: is .*true or false"),
        ("format: batchpid-osc-1\nframe: base", "frame: unknown option"),
        ("{", "cannot be read"),
    ],
)
def test_a_file_is_checked(text, message, tmp_path):
    path = tmp_path / "gains.yaml"
    path.write_text(text)
    with pytest.raises(InvalidArgumentError, match=message):
        ts.load_osc_options(path)


def test_unknown_options_are_not_written(tmp_path):
    with pytest.raises(InvalidArgumentError, match="options: unknown"):
        ts.save_osc_options(tmp_path / "gains.yaml", {"kp": 1.0})
    assert not [*tmp_path.iterdir()]
