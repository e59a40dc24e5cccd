"""First candidates of searches for robots that differ from the model."""

import numpy as np

from batchpid.sim.tuning.candidates import DESIGNS, GainCandidates
from batchpid.sim.tuning.moves import random_moves


def test_designs_have_their_poles(panda):
    options = {"headroom": 1.0, "drawn": False}
    moves = random_moves(panda, 1, 0)
    search = GainCandidates(panda, "mass_matrix", moves, 0.2, **options)
    params = search.params(search.designs())
    for row, (p, w) in enumerate(DESIGNS):
        for ki, kp, kd in zip(params.ki[row], params.kp[row], params.kd[row], strict=True):
            np.testing.assert_allclose([1, kd, kp, ki], np.poly([-p, -w, -w]), rtol=1e-9)
