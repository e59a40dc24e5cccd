"""Representations in a notebook: one to three lines, with the enabled options and their shapes."""

import numpy as np
from law_cases import DT, ENVS, JOINTS

import batchpid as bp


def test_params_show_the_options_that_are_on():
    params = bp.make_params(7, 40, 5, effort_max=87)
    assert repr(params) == "PIDParams(kp (1, 7), ki (1, 7), effort_max (1, 7))"
    assert "gain_units PerMassMatrix" in repr(bp.make_params(2, 1.0, gain_units="mass_matrix"))


def test_every_option_fits_on_three_lines(options):
    params = bp.make_params(JOINTS, **options)
    pid = bp.BatchPID(params, ENVS, DT)
    pid(np.ones(JOINTS), np.zeros((ENVS, JOINTS)))
    for shown in (params, pid.state):
        assert len(repr(shown).splitlines()) <= 3
        assert "array" not in repr(shown)
