"""Params and motors survive a file exactly, and a malformed or malicious file is refused."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from law_cases import JOINTS
from motor_cases import ALL

import batchpid as bp
from batchpid.io import documents

NAMES = ["shoulder", "elbow", "no"]  # "no" is a bool to careless YAML


def same(a, b):
    return all(
        (x is y is None)
        or (
            type(x) is type(y)
            and (not isinstance(x, np.ndarray) or (x.dtype == y.dtype and np.array_equal(x, y)))
        )
        for x, y in zip(a, b, strict=True)
    )


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_every_option_survives_a_file_and_a_text(options, dtype, tmp_path):
    params, path = bp.make_params(JOINTS, **options, dtype=dtype), tmp_path / "params.yaml"
    bp.save_params(path, params, NAMES, {"seed": 3})
    text = bp.dumps_params(params, NAMES)
    assert list(tmp_path.iterdir()) == [path]
    for loaded, names in (bp.load_params(path), bp.loads_params(text)):
        assert names == NAMES
        assert same(loaded, params)


@settings(max_examples=20)
@given(npst.arrays(float, (2, JOINTS), elements=st.floats(0, 1e300)))
def test_numbers_survive_a_file_exactly(tmp_path_factory, gains):
    path = tmp_path_factory.mktemp("params") / "params.yaml"
    params = bp.make_params(JOINTS, gains)
    bp.save_params(path, params, NAMES)
    assert same(bp.load_params(path)[0], params)


def test_joints_are_matched_by_name(tmp_path):
    path = tmp_path / "params.yaml"
    bp.save_params(path, bp.make_params(JOINTS, [1.0, 2.0, 3.0], ki=[[1, 2, 3], [4, 5, 6]]), NAMES)
    params, names = bp.load_params(path, NAMES[::-1])
    assert names == NAMES[::-1]
    assert params.kp.tolist() == [[3.0, 2.0, 1.0]]
    assert params.ki.tolist() == [[3, 2, 1], [6, 5, 4]]
    with pytest.raises(bp.InvalidArgumentError, match=r"missing \['wrist'\], unknown \['no'\]"):
        bp.load_params(path, ["shoulder", "elbow", "wrist"])


def test_a_file_written_by_hand(tmp_path):
    path = tmp_path / "params.yaml"
    path.write_text("""
format: batchpid-params-2
joints:
  a: {kp: 4, effort_max: 3}
  b: {kp: [1, 2.5], ki: 1.0e-3, continuous: true}
""")
    params, names = bp.load_params(path)
    assert names == ["a", "b"]
    assert params.kp.tolist() == [[4, 1], [4, 2.5]]
    assert params.ki.tolist() == [[0, 1e-3]]
    assert params.effort_max.tolist() == [[3, np.inf]]
    assert params.continuous.tolist() == [[0, 1]]
    assert params.effort_min is None


@pytest.mark.parametrize(
    "text",
    [
        "!!python/object/apply:os.mkdir [{marker}]",
        (
            "format: batchpid-params-2\njoints: {{a: {{kp: !!python/object/apply:os.mkdir"
            " [{marker}]}}}}"
        ),
    ],
)
def test_yaml_executes_nothing(text, tmp_path):
    path, marker = tmp_path / "params.yaml", tmp_path / "marker"
    path.write_text(text.format(marker=marker))
    with pytest.raises(bp.InvalidArgumentError, match="cannot be read"):
        bp.load_params(path)
    assert not marker.exists()


def test_a_save_that_is_refused_changes_no_file(tmp_path):
    path = tmp_path / "params.yaml"
    path.write_text("precious")
    params = bp.make_params(JOINTS, 1.0)
    for names in (NAMES[:2], ["a", "a", "b"]):
        with pytest.raises(bp.InvalidArgumentError, match="joint_names"):
            bp.save_params(path, params, names)
    with pytest.raises(bp.InvalidArgumentError, match=r"\.yaml"):
        bp.save_params(tmp_path / "params.toml", params, NAMES)
    assert path.read_text() == "precious"
    with pytest.raises(FileNotFoundError):
        bp.load_params(tmp_path / "none.yaml")


def test_about_survives_and_does_not_affect_the_params(tmp_path):
    units = {"gain_units": "mass_matrix", "discretization": "implicit"}
    params = bp.make_params(2, [1.0, 2.0], 0.5, **units)
    about = {"seed": 3, "versions": {"numpy": "2"}, "moves": ["a", "b"], "measurement_rate": True}
    with_about, without = tmp_path / "a.yaml", tmp_path / "b.yaml"
    bp.save_params(with_about, params, ["x", "y"], about)
    bp.save_params(without, params, ["x", "y"])
    assert documents.read(with_about)["about"] == about
    assert "about" not in documents.read(without)
    assert all(same(bp.load_params(path)[0], params) for path in (with_about, without))


@pytest.mark.parametrize(
    "value",
    [
        *(
            '!!int ""',
            "!!bool x",
            "!!binary '=='",
            "!!omap [a]",
        ),
        *(
            "2001-13-45",
            "1e999",
            "1" + "0" * 5000,
            ".nan",
            "{<<: 1}",
            "[&a 1.0, *a]",
        ),
        *("{a: " * 2_000, "- " * 2_000, "'" + "a\n" * 2_000, "\x00"),
    ],
)
def test_values_that_the_parser_trips_over_are_refused(value, tmp_path):
    path = tmp_path / "params.yaml"
    path.write_text(f"format: batchpid-params-2\njoints:\n  a:\n    kp: {value}\n")
    with pytest.raises(bp.InvalidArgumentError):
        bp.load_params(path)


def test_files_that_cannot_be_opened_are_named(tmp_path):
    (tmp_path / "folder.yaml").mkdir()
    for name in ("folder.yaml", "x" * 5000 + ".yaml", "nothing.yaml"):
        with pytest.raises(OSError, match=name):
            bp.load_params(tmp_path / name)


def test_a_file_of_another_version_is_refused():
    with pytest.raises(bp.InvalidArgumentError, match=r"batchpid-params-1; this one reads"):
        bp.loads_params('{"format": "batchpid-params-1", "joints": {"a": {"kp": 1.0}}}')


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_every_effect_of_motors_survives_a_file(dtype, tmp_path):
    joints = {"coulomb": [0.0, 0.1, 0.2, 0.3], "static": 0.4, "armature": 0.1}
    actuators, names = bp.make_actuators(4, **ALL, **joints, dtype=dtype), [*NAMES, "wrist"]
    bp.save_actuators(tmp_path / "a.yaml", actuators, names, about={"log": "chirp.csv"})
    loaded, read = bp.load_actuators(tmp_path / "a.yaml")
    assert read == names
    assert same(loaded, actuators)


def test_a_file_of_motors_written_by_hand(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_text("""
format: batchpid-actuators-2
joints:
  elbow: {strength: 0.9}
  shoulder: {coulomb: [0.1, 0.2]}
""")
    actuators, names = bp.load_actuators(path, ["shoulder", "wrist", "elbow"])
    assert names == ["shoulder", "wrist", "elbow"]
    assert actuators.strength.tolist() == [[1.0, 1.0, 0.9]]
    assert actuators.coulomb.tolist() == [[0.1, 0.0, 0.0], [0.2, 0.0, 0.0]]
