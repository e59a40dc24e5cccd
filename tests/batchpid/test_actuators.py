"""Actuators: parameters checked, histories matched, off at no cost."""

import numpy as np
import pytest

import batchpid as bp
from batchpid.errors import InvalidArgumentError

DT = 1 / 2000


def test_a_neutral_value_is_off():
    actuators = bp.make_actuators(
        2, command_delay=0.0, strength=1.0, bias=0.0, effort_limit=np.inf, armature=0.0
    )
    assert all(leaf is None for leaf in actuators)
    assert actuators.is_ideal
    assert not bp.make_actuators(2, viscous=1.0).is_ideal
    assert not bp.make_actuators(2, backlash=1.0).is_ideal
    assert not actuators.measures
    assert not actuators.delivers
    q = np.zeros((3, 2))
    state = bp.motors.init(actuators, q, DT)
    assert state.leaves() == {}
    effort = np.ones((3, 2))
    k = bp.motors.discretise(actuators, state, DT)
    assert bp.motors.advance_effort(k, state, effort, q)[1] is effort


def test_replace():
    actuators = bp.make_actuators(2, strength=[[0.9, 1.0], [1.1, 1.2]], bias=0.5)
    assert actuators.replace(bias=None).bias is None
    np.testing.assert_array_equal(actuators.replace(lag=0.01).strength, actuators.strength)
    assert repr(actuators) == "Actuators(strength (2, 2), bias (1, 2))"
    with pytest.raises(InvalidArgumentError, match="every effect is off"):
        bp.make_actuators(2).replace(lag=0.1)


def test_a_delay_in_float32_is_not_above_the_longest():
    jax = pytest.importorskip("jax")
    motors = bp.make_actuators(2, command_delay=0.004)
    share = jax.vmap(lambda strength: motors.replace(strength=strength).strength[0])
    assert share(jax.numpy.ones((3, 2), "float32")).shape == (3, 2)
