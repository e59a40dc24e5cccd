"""advance_drive: its edges; test_law_conformance.py compares the drive with the law."""

import numpy as np
import pytest
from law_cases import DRIVE_LACKS, DT, ENVS, JOINTS

import batchpid as bp
from batchpid.errors import InvalidArgumentError
from batchpid.law.pid import advance_drive
from batchpid.law.state import check_drive


def test_without_stiffness_the_target_is_the_setpoint():
    params = bp.make_params(JOINTS, [0.0, 1.0, 2.0], 5.0)
    y = np.zeros((ENVS, JOINTS))
    k, state = bp.discretise(params, DT), bp.init(params, y)
    for _ in range(3):
        state, target = advance_drive(k, state, y + 1, y)
    assert (target[:, 0] == 1).all()
    assert (target[:, 1:] > 1).all()
    assert np.isfinite(target).all()


@pytest.mark.parametrize("name", DRIVE_LACKS)
def test_a_drive_refuses_options_that_it_does_not_have(name):
    params = bp.make_params(1, 4.0, 1.0, 1.0, **{name: 0.3})
    with pytest.raises(InvalidArgumentError, match=rf"params.{name}: .*replace\({name}="):
        check_drive(params)
