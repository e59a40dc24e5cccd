"""Representations in a notebook: one to three lines, with the enabled options and the ranges of the
values.
"""

import jax
import numpy as np
import pytest
from law_cases import DT, ENVS, JOINTS

import batchpid as bp


def test_params_show_the_options_that_are_on():
    params = bp.make_params(7, [40, 50, 60, 70, 80, 87, 87], 5, 2, effort_max=87)
    assert repr(params) == "PIDParams(1 env, 7 joints, kp 40 to 87, ki 5, kd 2, effort_max 87)"
    assert "gain_units PerMassMatrix" in repr(bp.make_params(2, 1.0, gain_units="mass_matrix"))


def test_every_option_fits_on_three_lines(options):
    params = bp.make_params(JOINTS, **options)
    pid = bp.BatchPID(params, ENVS, DT)
    pid(np.ones(JOINTS), np.zeros((ENVS, JOINTS)))
    for shown in (params, pid.state):
        assert len(repr(shown).splitlines()) <= 3
        assert "array" not in repr(shown)


@pytest.mark.filterwarnings("error")
def test_trees_of_any_leaves_have_a_representation():
    params = bp.make_params(2, 1.0, effort_limit=2.0, continuous=True)
    for tree in (
        jax.tree.map(lambda leaf: object(), params),
        jax.tree.map(lambda leaf: 0, params),
        jax.eval_shape(lambda: params),
        bp.PIDParams(np.full((1, 2), np.nan)),
        bp.PIDState(),
    ):
        assert type(tree).__name__ in repr(tree)
    seen = []
    jax.jit(lambda params: seen.append(repr(params)))(params)
    assert "kp traced, effort_min traced" in seen[0]
