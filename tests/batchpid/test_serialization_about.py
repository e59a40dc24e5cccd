"""What is kept beside the params in their file."""

from __future__ import annotations

import pytest

import batchpid as bp
from batchpid.errors import InvalidArgumentError


@pytest.mark.parametrize("suffix", [".yaml", ".json"])
def test_about_comes_back_and_does_not_touch_the_params(tmp_path, suffix):
    params = bp.make_params(2, [1.0, 2.0], 0.5, gain_units="mass_matrix")
    about = {"seed": 3, "versions": {"numpy": "2"}, "moves": ["a", "b"], "measurement_rate": True}
    with_about, without = tmp_path / f"a{suffix}", tmp_path / f"b{suffix}"
    bp.save_params(with_about, params, ["x", "y"], about)
    bp.save_params(without, params, ["x", "y"])
    assert bp.load_about(with_about) == about
    assert bp.load_about(without) == {}
    loaded = [bp.load_params(path)[0] for path in (with_about, without)]
    assert loaded[0].gain_units == loaded[1].gain_units == params.gain_units
    assert (loaded[0].kp == params.kp).all()


def test_about_must_be_a_mapping(tmp_path):
    path = tmp_path / "p.yaml"
    path.write_text("format: batchpid-params-1\nabout: 3\njoints: {x: {kp: 1.0}}\n")
    with pytest.raises(InvalidArgumentError, match="about"):
        bp.load_params(path)
