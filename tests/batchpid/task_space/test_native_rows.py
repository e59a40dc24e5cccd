"""Native kinematics, dynamics and law against NumPy's, over random trees, rows and options."""

import dataclasses
from unittest import mock

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from trees import planar, states, tool_of, tree_of

import batchpid.task_space as ts
from batchpid.task_space import native_rows

pytestmark = pytest.mark.skipif(native_rows.in_use() is None, reason="there is no extension")

TREES = ["panda", "jaco2", *range(8)]
MASKS = st.just([True] * 6) | st.lists(st.booleans(), min_size=6, max_size=6)


def both(function):
    """Return the results of native code and of NumPy."""
    found = function()
    with mock.patch.dict("os.environ", {"BATCHPID_NATIVE": "0"}):
        return found, function()


def assert_same(found, wanted, tolerance):
    wanted = np.asarray(wanted)
    assert found.shape == wanted.shape
    assert found.dtype == wanted.dtype
    assert np.abs(found - wanted).max(initial=0) <= tolerance * np.abs(wanted).max(initial=1.0)


@settings(max_examples=20)
@given(st.lists(st.floats(-1e9, 1e9) | st.floats(-7.0, 7.0), min_size=1, max_size=9))
def test_sine_and_cosine_are_exact_to_the_last_bits_at_any_angle(angles):
    at = np.array(angles)[:, None]
    jacobian = ts.jacobian(planar((1.0,)), at, "tip")
    np.testing.assert_allclose(
        jacobian[:, :2], np.stack([-np.sin(at), np.cos(at)], axis=1), rtol=0, atol=3e-16
    )
    for row in range(len(at)):
        np.testing.assert_array_equal(
            ts.jacobian(planar((1.0,)), at[row : row + 1], "tip")[0], jacobian[row]
        )


@settings(max_examples=25)
@given(
    name=st.sampled_from(TREES),
    rows=st.integers(0, 9),
    seed=st.integers(0, 2**31),
    pointed=st.sampled_from([0, 1, 2]),
)
def test_kinematics_and_dynamics(name, rows, seed, pointed):
    tree, tool = tree_of(name), tool_of(name)
    qpos, qvel = states(tree, rows, seed)
    rng = np.random.default_rng(seed)
    point = [None, rng.normal(size=3), rng.normal(size=(rows, 3))][pointed]
    link = tree.links[rng.integers(len(tree.links))] if seed % 2 else tool
    for function in (
        lambda: ts.jacobian(tree, qpos, link, point=point),
        lambda: ts.jacobian_rate(tree, qpos, qvel, link, point=point),
        lambda: ts.mass_matrix(tree, qpos),
        lambda: ts.bias(tree, qpos, qvel),
        lambda: ts.inverse_dynamics(tree, qpos, qvel, qvel[::-1]),
        lambda: ts.link_poses(tree, qpos[:, None]),
    ):
        assert_same(*both(function), 1e-12)
    for leaf, other in zip(
        *both(lambda: ts.task_dynamics(tree, qpos, qvel, link, point=point)), strict=True
    ):
        assert_same(leaf, other, 1e-12)


@settings(max_examples=30)
@given(
    name=st.sampled_from(["panda", "jaco2", 0, 1, 2]),
    rows=st.integers(1, 9),
    seed=st.integers(0, 2**31),
    axes=MASKS,
    smallest=st.sampled_from([0.02, 0.5, 10.0]),
    extras=st.integers(0, 15),
    limit=st.sampled_from([200.0, None]),
    learns=st.booleans(),
    avoids=st.booleans(),
)
@example(
    "panda",
    1,
    104,
    [False, False, False, True, False, True],
    10.0,
    0,
    200.0,
    True,
    False,
)
def test_the_law(name, rows, seed, axes, smallest, extras, limit, learns, avoids):
    tree, tool = tree_of(name), tool_of(name)
    qpos, qvel = states(tree, rows, seed)
    goal = ts.link_poses(tree, states(tree, rows, seed + 1)[0], [tool])[:, 0]
    rng = np.random.default_rng(seed)
    options = {"axes": axes, "effort_limit": limit}
    options |= {"integral_gain": 50.0, "integral_limit": 1.0} if learns else {}
    options |= {"limit_margin": 0.5} if avoids else {}
    options |= {"discretization": "implicit"} if seed % 2 else {}
    stiffness = rng.uniform(50, 200, (1 if seed % 3 else rows, 6))
    params = ts.make_osc_params(
        tree, 1e-3, stiffness=stiffness, smallest_eigenvalue=smallest, **options
    )
    names = "twist", "acceleration", "wrench", "feedforward"
    given = {
        key: rng.normal(size=(rows, tree.dof if key == "feedforward" else 6))
        for bit, key in enumerate(names)
        if extras >> bit & 1
    }
    state = ts.OSCState(
        qpos + 0.1 * rng.normal(size=qpos.shape), rng.normal(size=(rows, 6)) if learns else None
    )
    inputs = (
        params,
        state,
        ts.Tool(tree, tool),
        ts.OSCInputs(goal, qpos, qvel, **given),
    )
    (new, found), (plain, wanted) = both(lambda: ts.osc(*inputs))
    if learns:
        assert_same(new.integral, plain.integral, 1e-12)
    np.testing.assert_array_equal(found.near_singular, wanted.near_singular)
    # The inverse amplifies the rounding of A, which is relative to its norm, by 1/s0 at most.
    d = ts.task_dynamics(tree, qpos, qvel, tool)
    mobility = d.jacobian @ np.linalg.solve(d.mass_matrix, d.jacobian.swapaxes(1, 2))
    tolerance = 1e-12 * (1 + np.abs(mobility).max() / smallest)
    for key in ("error", "wrench", "task", "posture", "unsaturated", "effort"):
        assert_same(getattr(found, key), getattr(wanted, key), tolerance)
    for key in ("task", "posture"):  # the share of an effort of 1e-15 N m may be 0 or 1
        parts = [
            getattr(terms, f"{key}_share")[:, None] * getattr(terms, key)
            for terms in (found, wanted)
        ]
        assert_same(*parts, 10 * tolerance)


@settings(max_examples=25)
@example(name=1, rows=7, seed=226, distance=0.3, iterations=2, pointed=True, narrow=True)
@given(
    name=st.sampled_from(TREES),
    rows=st.integers(1, 9),
    seed=st.integers(0, 2**31),
    distance=st.sampled_from([0.02, 0.3, 3.0]),
    iterations=st.integers(1, 3),
    pointed=st.booleans(),
    narrow=st.booleans(),
)
def test_inverse_kinematics(name, rows, seed, distance, iterations, pointed, narrow):
    """A few steps of a search; in many steps rounding leads to other solutions."""
    tree, tool, rng = tree_of(name), tool_of(name), np.random.default_rng(seed)
    qpos, _ = states(tree, rows, seed)
    start = qpos + distance * rng.uniform(-1, 1, qpos.shape)
    if narrow:  # joints stop at their limits
        middle = states(tree, 1, seed + 1)[0][0]
        tree = dataclasses.replace(tree, lower=middle - 0.3, upper=middle + 0.3)
    point = rng.normal(size=3) if pointed else None
    pose = ts.link_poses(tree, qpos, [tool], point=point)[:, 0]
    options = {"point": point, "starts": 1, "iterations": iterations, "on_failure": "return"}
    found, wanted = both(lambda: ts.inverse_kinematics(tree, tool, pose, start, **options))
    # A step amplifies rounding by the inverse of its damping at most, which is the error's.
    size = wanted.position_error**2 + wanted.rotation_error**2
    tolerance = 1e-13 / (1e-8 + 0.05 * size.min(initial=1.0))
    for leaf in ("qpos", "position_error", "rotation_error"):
        assert_same(getattr(found, leaf), getattr(wanted, leaf), tolerance)
    more = np.abs(found.iterations - wanted.iterations)
    assert not more[wanted.success].any()
    assert (
        more <= 1
    ).all()  # at a limit, a last step that gains nothing is taken or not, by rounding
