"""Actuators survive a file exactly, joints are matched by name, and a malformed file is refused."""

import numpy as np
import pytest
from motor_cases import ALL

import batchpid as bp

NAMES = ["shoulder", "elbow", "no", "wrist"]


def same(first, second):
    return all(
        (x is y is None) or (x.dtype == y.dtype and x.shape == y.shape and np.array_equal(x, y))
        for x, y in zip(first, second, strict=True)
    )


@pytest.mark.parametrize("suffix", [".yaml", ".json"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_every_effect_survives_a_file(suffix, dtype, tmp_path):
    actuators = bp.make_actuators(
        4, **ALL, coulomb=[0.0, 0.1, 0.2, 0.3], static=0.4, armature=0.1, dtype=dtype
    )
    bp.save_actuators(tmp_path / f"a{suffix}", actuators, NAMES, about={"log": "chirp.csv"})
    loaded, names = bp.load_actuators(tmp_path / f"a{suffix}")
    assert names == NAMES
    assert same(loaded, actuators)


def test_a_file_written_by_hand(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_text("""
format: batchpid-actuators-1
joints:
  elbow: {strength: 0.9}
  shoulder: {coulomb: [0.1, 0.2]}
""")
    actuators, names = bp.load_actuators(path, ["shoulder", "wrist", "elbow"])
    assert names == ["shoulder", "wrist", "elbow"]
    assert actuators.strength.tolist() == [[1.0, 1.0, 0.9]]
    assert actuators.coulomb.tolist() == [[0.1, 0.0, 0.0], [0.2, 0.0, 0.0]]
