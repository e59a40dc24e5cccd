"""A robot's designed gains, target and repr, and robots from pipes."""

import sys
import warnings
from pathlib import Path
from subprocess import run
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from robots import load_bundled
from tiny_urdf import INERTIAL, one_joint, random_tree, write

from batchpid.errors import InvalidArgumentError
from batchpid.sim import Robot


@given(st.integers(0, 2**32), st.floats(-4, 4), st.floats(0, 9))
@settings(max_examples=20, deadline=None)
def test_every_robot_has_a_target_within_its_limits(seed, low, width):
    parts = "".join(random_tree(np.random.default_rng(seed), 6))
    text = parts.replace('lower="-9" upper="9"', f'lower="{low}" upper="{low + width}"')
    with TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        loaded = Robot.load(write(Path(folder), f'<robot name="x">{text}</robot>'))
    np.testing.assert_allclose(
        np.clip(loaded.target, loaded.lower, loaded.upper), loaded.target, atol=1e-6
    )
    room = np.maximum(loaded.upper - loaded.start, loaded.start - loaded.lower)
    assert (np.abs(loaded.target - loaded.start) <= np.minimum(0.25 * room, 0.5) + 1e-12).all()
    model = loaded.dynamics()
    if not model.in_contact(loaded.start[None])[0]:
        assert not model.in_contact(loaded.target[None])[0]
    assert (load_bundled("panda").target == load_bundled("panda").settings.target).all()


@pytest.mark.parametrize("low", [0.1, 1.0])
def test_the_target_is_free_of_the_ground(low, tmp_path):
    """The farther limit is below: half a radian towards it, the tip would be in the ground."""
    box = '<collision><origin xyz="0.2 0 0"/><geometry><box size="0.4 0.04 0.04"/></geometry></collision>'
    limit = '<limit lower="-1" upper="2" effort="10" velocity="2"/>'
    text = one_joint(limit, arm=INERTIAL + box).replace('xyz="0 0 1"', f'xyz="0 0 {low}"')
    loaded = Robot.load(write(tmp_path, text))
    assert not loaded.dynamics().in_contact(loaded.target[None])[0]
    assert (loaded.target[0] == 0.5) == (low == 1.0)
    assert abs(loaded.target[0]) >= 0.1


def test_a_robot_from_a_pipe():
    program = (
        "import sys; from batchpid.sim import Robot; print(Robot.load('/dev/stdin').joint_names)"
    )
    done = run(
        [sys.executable, "-c", program],
        input=one_joint(),
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout == "('hinge',)\n"
    shown = run(
        ["bash", "-c", f"'{sys.executable}' -m batchpid inspect <(cat)"],
        input=one_joint(),
        capture_output=True,
        text=True,
    )
    assert shown.returncode == 0, shown.stderr
    assert "hinge" in shown.stdout


def test_designed_gains_have_one_bandwidth_with_the_mass_matrix(panda):
    params = panda.designed()
    np.testing.assert_allclose(params.kp, (2 * np.pi * 1.7) ** 2)
    with pytest.raises(InvalidArgumentError, match=r"gain_units.*'mass'.*use one of"):
        panda.designed("mass")


def test_the_repr_names_robot_size_and_file(panda):
    assert repr(panda) == f"Robot('panda', 9 dof, path={str(panda.path)!r})"
