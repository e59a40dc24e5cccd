"""Rotations: laws of quaternions and of roll, pitch and yaw."""

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from batchpid.task_space.rotations import from_rpy, to_rpy

angles = st.one_of(st.floats(-math.pi, math.pi), st.sampled_from([0.0, math.pi / 2, -math.pi / 2, math.pi, 1.5707963]))


@given(st.tuples(angles, angles, angles))
def test_rpy_of_a_rotation_gives_the_rotation_also_at_a_right_angle(rpy):
    q = from_rpy(rpy)
    assert abs(from_rpy(to_rpy(q)) @ q) > 1 - 1e-15  # q and -q are one rotation
    again = from_rpy(to_rpy(q))
    np.testing.assert_allclose(again * np.sign(again @ q), q, atol=1e-14)
