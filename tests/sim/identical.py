"""Bit-identity of results."""

import numpy as np

from batchpid.sim import Observation


def assert_identical(first, second, envs=slice(None), skip=()):
    """Raise AssertionError unless the fields of ``second`` are bit-identical in ``first``.

    Both are observations, rollouts or recordings. ``envs`` selects the envs to compare, ``skip``
    names fields that may differ.
    """
    rows = (*[slice(None)] * (second.ok.ndim - 1), envs)
    seen = {name for name in Observation._fields if getattr(second, name) is not None}
    for name in (seen | {"setpoint", "time"} if hasattr(second, "time") else seen) - set(skip):
        ours, theirs = getattr(first, name), getattr(second, name)
        if name != "time":
            ours, theirs = ours[rows], theirs[rows]
        np.testing.assert_array_equal(ours, theirs, name)
        assert ours.dtype == theirs.dtype, name
        assert ours.tobytes() == theirs.tobytes(), f"{name} differs in NaNs or in the sign of zeros"


def are_same_params(first, second):
    """Return whether params have the same options with equal values."""
    return first.options().keys() == second.options().keys() and all(
        np.array_equal(value, second.options()[name]) for name, value in first.options().items()
    )
