"""make_params: broadcasting, options that are off, and errors that name option, joint, env and
value.
"""

import copy
import pickle

import numpy as np
import pytest

import batchpid as bp


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


def test_replace_changes_the_given_options_alone():
    params = bp.make_params(2, 1.0, 1.0, effort_limit=5.0, anti_windup="back_calculation")
    changed = params.replace(kp=[3.0, 4.0], effort_limit=2.0)
    assert changed.kp.tolist() == [[3, 4]]
    assert changed.effort_min.tolist() == [[-2, -2]]
    assert changed.tracking_time.tolist() == params.tracking_time.tolist()
    assert params.replace(anti_windup="none").tracking_time is None
