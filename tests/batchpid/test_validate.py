"""Checks of arguments: a good value is returned in its canonical form, a bad one is named."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from batchpid.checks import validate
from batchpid.errors import InvalidArgumentError

JOINTS = ("shoulder", "elbow")


@pytest.mark.parametrize(
    ("checked", "expected"),
    [
        (lambda: validate.integer("n", np.int64(3), 1, 5), 3),
        (lambda: validate.number("x", np.float32(0.5), 0, 1, "s"), 0.5),
        (lambda: validate.number("x", 7, 0, np.inf, "s"), 7.0),
        (lambda: validate.positive("dt", 1e-3, "s"), 1e-3),
        (lambda: validate.choice("kind", "b", ("a", "b")), "b"),
        (lambda: validate.flag("on", np.True_), True),
        (lambda: validate.instance("text", "a", str, "pass text"), "a"),
        (lambda: validate.names("joint_names", JOINTS, 2), list(JOINTS)),
        (lambda: validate.file_path("out", "run.NPZ", (".npz",)).name, "run.NPZ"),
        (lambda: validate.array("qpos", [1, 2], (3, 2), JOINTS).tolist(), [[1, 2]] * 3),
        (lambda: validate.broadcast("kp", [[1], [2]], (2, 2)).tolist(), [[1, 1], [2, 2]]),
        (lambda: validate.within("qpos", np.array([[np.nan, 2]]), 3.0, JOINTS)[0, 1].item(), 2.0),
        (lambda: validate.joint_speeds("speed", 2, JOINTS).tolist(), [2, 2]),
        (lambda: validate.env_mask("mask", [True, False], 2).tolist(), [True, False]),
    ],
)
def test_a_good_value_comes_back_in_its_canonical_form(checked, expected):
    value = checked()
    assert value == expected
    assert type(value) is type(expected)


@pytest.mark.parametrize(
    ("checked", "said"),
    [
        (lambda: validate.integer("n", True, 1, 5), "n: must be a whole number .got True."),
        (lambda: validate.integer("n", 6, 1, 5), "n: out of range .got 6.; use a number from 1 to 5"),
        (lambda: validate.number("x", "1", 0, 1, "s"), "x: must be a number .got '1'.; pass a float .s."),
        (lambda: validate.number("x", 1j, 0, 1, "s"), "x: must be a number"),
        (lambda: validate.number("x", np.nan, 0, 1, "s"), "x: out of range .got nan.; use a number from 0 to 1 .s."),
        (lambda: validate.number("x", np.inf, 0, np.inf, "s"), "x: out of range .got inf.; use a number >= 0 .s."),
        (lambda: validate.number("x", 10**400, 0, np.inf, "s"), "x: out of range"),
        (lambda: validate.positive("dt", 0, "s"), "dt: must be positive and finite .got 0.0.; use a number > 0 .s."),
        (lambda: validate.choice("kind", "c", ("a", "b")), "kind: unknown option .got 'c'.; use one of 'a', 'b'"),
        (lambda: validate.flag("on", 1), "on: must be True or False"),
        (lambda: validate.instance("text", 3, str, "pass text"), "text: must be a str .got 3.; pass text"),
        (lambda: validate.names("joint_names", "ab"), "joint_names: must be a list of names"),
        (lambda: validate.names("joint_names", ["a", 2]), "joint_names: must be a list of names"),
        (lambda: validate.names("joint_names", ["a"], 2), "joint_names: has 1 names, needs 2"),
        (lambda: validate.names("joint_names", ["a", "a"]), "joint_names: repeats a name"),
        (lambda: validate.file_path("out", 3), "out: must be a path"),
        (lambda: validate.file_path("out", "a\0b"), "out: must be a path"),
        (lambda: validate.file_path("out", "run.txt", (".npz", ".h5")), "out: unknown file .* end it in .npz or .h5"),
        (lambda: validate.array("qpos", "a", (3, 2), JOINTS), "qpos: cannot be read as an array of numbers"),
        (lambda: validate.array("qpos", [1], (3, 2), JOINTS), r"qpos: has shape \(1,\), not \(3, 2\) or \(2,\)"),
        (lambda: validate.array("qpos", [1, np.inf], (3, 2), JOINTS), "qpos, joint 'elbow', env 0: is not finite"),
        (lambda: validate.array("qpos", [1, np.inf], (1, 2), JOINTS), "qpos, joint 'elbow': is not finite .got inf."),
        (lambda: validate.broadcast("kp", [1, 2, 3], (2, 2)), r"kp: has shape \(3,\), which does not broadcast"),
        (lambda: validate.within("qpos", np.array([[0.0], [-4]]), 3.0, JOINTS), "'shoulder', env 1: is beyond.*-4.0"),
        (lambda: validate.joint_speeds("speed", [1, 0], JOINTS), "speed, joint 'elbow': must be > 0 .got 0.0."),
        (lambda: validate.env_mask("mask", [1, 0], 2), "mask: cannot be read as an array of bools"),
        (lambda: validate.env_mask("mask", [True], 2), r"mask: has shape \(1,\), needs \(2,\)"),
        (lambda: validate.entries("kp", np.float64(-1), False, "is negative"), "kp: is negative .got -1.0."),
    ],
)
def test_a_bad_value_is_named_with_its_remedy(checked, said):
    with pytest.raises(InvalidArgumentError, match=said):
        checked()


def test_is_traced_is_true_for_traced_arrays_alone():
    seen = []
    jax.jit(lambda x: seen.append(validate.is_traced(x)))(jnp.ones(2))
    assert seen == [True]
    assert not validate.is_traced(jnp.ones(2))
    assert not validate.is_traced(np.ones(2))
