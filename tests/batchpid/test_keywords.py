"""Unknown keyword arguments: an error names the nearest known one, also through functions that pass them on."""

import pytest

import batchpid as bp
from batchpid.errors import InvalidArgumentError

PARAMS = bp.make_params(2, kp=1.0)
ACTUATORS = bp.make_actuators(2, lag=0.01)


@pytest.mark.parametrize(
    "call",
    [
        lambda: bp.make_params(2, kp=1.0, efort_limit=3.0),
        lambda: PARAMS.replace(efort_limit=3.0),
        lambda: bp.presets.tutorial(2, efort_limit=3.0),
        lambda: bp.make_actuators(2, efort_limit=3.0),
        lambda: ACTUATORS.replace(efort_limit=3.0),
        lambda: bp.motors.presets.remotized(2, [[0.0, 1.0, 1.0], [1.0, 1.0, 1.0]], efort_limit=3.0),
    ],
)
def test_an_unknown_option_is_named_with_the_nearest(call):
    with pytest.raises(InvalidArgumentError, match=r"efort_limit: is not an argument of make_.*'effort_limit'"):
        call()


def test_an_option_like_no_other_is_answered_with_all():
    with pytest.raises(InvalidArgumentError, match=r"use one of joints, kp, ki, kd"):
        bp.make_params(2, kp=1.0, zzzzzzz=1)
