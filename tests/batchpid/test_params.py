"""make_params: broadcasting, options that are off, and errors that name option, joint, env and value."""

import copy
import pickle

import numpy as np
import pytest
from law_cases import ENVS, JOINTS

import batchpid as bp
from batchpid.arrays.choices import Everywhere


def test_scalars_and_vectors_broadcast():
    per_env = np.arange(6.0).reshape(2, 3)
    params = bp.make_params(3, kp=2, ki=[1, 2, 3], kd=per_env, deadband=[[0.1], [0.2]])
    assert params.kp.tolist() == [[2, 2, 2]]
    assert params.ki.tolist() == [[1, 2, 3]]
    assert params.kd.tolist() == per_env.tolist()
    assert params.deadband.tolist() == [[0.1] * 3, [0.2] * 3]
    assert (params.num_joints, params.num_envs, params.dtype) == (3, 2, np.float64)
    assert params.for_envs(slice(1, 2)).kd.tolist() == [[3, 4, 5]]
    assert params.for_envs(slice(1, 2)).kp is params.kp


def test_params_are_read_only_copies():
    """Read-only, not views of the arguments, and they survive pickle and copy."""
    gains = np.ones(3)
    params = bp.make_params(3, gains, anti_windup="conditional", effort_limit=1.0, ki=1.0)
    gains[:] = 9
    assert params.kp.tolist() == [[1, 1, 1]]
    with pytest.raises(ValueError, match="read-only"):
        params.kp[0, 0] = 5
    for again in (pickle.loads(pickle.dumps(params)), copy.deepcopy(params)):
        assert [type(leaf) for leaf in again] == [type(leaf) for leaf in params]


def test_options_build_the_same_params(options):
    params = bp.make_params(JOINTS, **options)
    for again in (bp.make_params(JOINTS, **params.options()), params.replace()):
        assert [type(leaf) for leaf in again] == [type(leaf) for leaf in params]
        assert all(np.array_equal(a, b) for a, b in zip(params, again, strict=True) if isinstance(a, np.ndarray))


def test_replace_changes_the_given_options_alone():
    params = bp.make_params(2, 1.0, 1.0, effort_limit=5.0, anti_windup="back_calculation")
    changed = params.replace(kp=[3.0, 4.0], effort_limit=2.0)
    assert changed.kp.tolist() == [[3, 4]]
    assert changed.effort_min.tolist() == [[-2, -2]]
    assert changed.tracking_time.tolist() == params.tracking_time.tolist()
    assert params.replace(anti_windup="none").tracking_time is None


def test_uniform_strategies_need_no_mask():
    uniform = bp.make_params(2, 1.0, 1.0, effort_limit=1.0, anti_windup="conditional")
    mixed = bp.make_params(2, 1.0, 1.0, effort_limit=1.0, anti_windup=["conditional", "none"])
    assert isinstance(uniform.conditional, Everywhere)
    assert mixed.conditional.tolist() == [[1, 0]]


BAD = {
    "missing kp": ({"kp": None}, "kp: is missing"),
    "negative gain": ({"kp": [1, -2, 3]}, r"kp, joint 1: .*-2.0"),
    "nan gain": ({"kd": [[1, 2, 3], [1, 2, np.nan]]}, r"kd, joint 2, env 1: .*nan"),
    "infinite gain": ({"ki": np.inf}, "ki, joint 0: must be finite"),
    "text": ({"kp": "high"}, "kp: cannot be read as an array of numbers"),
    "ragged": ({"kp": [[1, 2, 3], [1]]}, "kp: cannot be read as an array of numbers"),
    "complex": ({"kp": 1j}, "kp: cannot be read as an array of numbers"),
    "bool": ({"kp": True}, "kp: cannot be read as an array of numbers"),
    "length": ({"kd": [1, 2]}, r"kd: has shape \(2,\), not"),
    "rank": ({"kd": np.ones((1, 1, 3))}, r"kd: has shape \(1, 1, 3\)"),
    "envs": ({"kp": np.ones((2, 3)), "kd": np.ones((4, 3))}, r"kd: has shape \(4, 3\), not \(2, 3\)"),
    "no envs": ({"kp": np.ones((0, 3))}, r"kp: has shape \(0, 3\)"),
    "swapped limits": ({"effort_min": [0, 0, 2], "effort_max": 1}, "effort_min, joint 2: exceeds effort_max"),
    "two limits": ({"effort_limit": 1, "effort_max": 2}, "effort_limit: is given together"),
    "nan limit": ({"effort_limit": [1, np.nan, 1]}, "effort_limit, joint 1"),
    "negative limit": ({"integral_limit": -1}, "integral_limit, joint 0.*-1.0"),
    "rate": ({"effort_rate_limit": 0.0}, "effort_rate_limit, joint 0.*> 0"),
    "filter": ({"derivative_filter_time": -0.1}, "derivative_filter_time"),
    "deadband": ({"deadband": np.inf}, "deadband"),
    "strategy": ({"anti_windup": ["none", "wind", "none"]}, "anti_windup, joint 1: .*'wind'.*back_calculation"),
    "clamp": ({"anti_windup": "clamp"}, "anti_windup: 'clamp' has no limit"),
    "tracking": ({"tracking_time": 1.0}, "tracking_time: is given, but no joint"),
    "continuous": ({"continuous": 1.0}, "continuous: cannot be read as an array of bools"),
    "integration": ({"integration": "last"}, "integration: .*'last'.*'output_first', 'integrate_first'"),
    "non_finite": ({"non_finite": None}, "non_finite: .*'propagate', 'zero', 'hold'"),
    "dtype": ({"dtype": np.float16}, "dtype: .*float32"),
    "no dtype": ({"dtype": "number"}, "dtype: .*float32"),
    "joints": ({"joints": 0}, "joints: .*0.*from 1 to"),
    "fractional joints": ({"joints": 2.5}, "joints: .*whole"),
    "names": ({"joint_names": ["a"]}, "joint_names: has 1 names, needs 3"),
}


@pytest.mark.parametrize(("options", "said"), BAD.values(), ids=BAD)
def test_bad_options_are_named(options, said):
    with pytest.raises(bp.InvalidArgumentError, match=said):
        bp.make_params(**({"joints": 3, "kp": 1.0, "ki": 1.0} | options))


def test_errors_use_the_joint_names():
    with pytest.raises(bp.InvalidArgumentError, match="kp, joint 'elbow'") as caught:
        bp.make_params(2, [1.0, -1.0], joint_names=["shoulder", "elbow"])
    error = caught.value
    assert (error.argument, error.joint, error.env, error.value) == ("kp", "elbow", None, -1.0)


def test_params_for_another_number_of_envs_are_refused():
    params = bp.make_params(JOINTS, np.ones((ENVS, JOINTS)))
    params.check(ENVS)
    with pytest.raises(bp.InvalidArgumentError, match=r"params\.kp: has shape"):
        params.check(ENVS + 1)
