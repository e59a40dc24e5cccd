"""Views of ticks: those that :meth:`Arrays.at` returns, made when first used, and once."""

import numpy as np
import pytest

from batchpid.sim.loop.arrays import Arrays, Ticks

LAYOUT = Arrays.layout(5, 3, 2)


@pytest.fixture
def arrays():
    rng = np.random.default_rng(0)
    return Arrays.from_fields({name: rng.uniform(0, 9, shape).astype(dtype) for name, (shape, dtype) in LAYOUT.items()})


def test_views_of_ticks_are_those_at_their_indices(arrays):
    ticks = Ticks(arrays)
    assert len(ticks) == 5
    third = ticks[2]
    for count in (1, 5, 2):
        assert len(ticks.first(count)) == count
        for tick, views in enumerate(ticks.first(count)):
            for ours, theirs in zip(views, arrays.at(tick), strict=True):
                for one, other in zip(ours, theirs, strict=True):
                    assert one is other is None or np.shares_memory(one, other)
                    np.testing.assert_array_equal(one, other, strict=True)
    assert ticks[2] is ticks.first(5)[2] is third
    with pytest.raises(IndexError):
        ticks[5]
