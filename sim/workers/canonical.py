"""Canonical episode: a short run with equal digests on machines that round in the same way."""

from __future__ import annotations

import hashlib
from dataclasses import replace

import numpy as np

import batchpid as bp
from batchpid.io.versions import package_versions
from batchpid.sim.loop.arrays import Arrays, Command
from batchpid.sim.loop.loop import Loop
from batchpid.sim.observation import OBSERVED
from batchpid.sim.options import RunnerOptions

_TICKS, _SUBSTEPS, _STEP = 5, 20, 0.1  # rad, m, N m or N: small enough for any robot


def canonical_digest(options: RunnerOptions, params: bp.PIDParams) -> str:
    """Return a digest of batchpid's version and of every bit of an episode of one robot, without the user's content.

    ``params`` are of one env. The episode runs the law, the physics and the robot that the runner with ``options``
    runs, with the instructions that NumPy, OpenBLAS and XLA choose on this machine.
    """
    robot = options.robot
    options = replace(options, num_envs=1, build=None, randomization=None, actuators=None)
    layout = Arrays.layout(_TICKS, 1, robot.dof, options.command.size)
    fields = {name: np.zeros(shape, dtype) for name, (shape, dtype) in layout.items()}
    arrays = Arrays.from_fields(fields)
    start = robot.start[None]
    neutral = np.asarray(options.command.neutral)
    arrays.command.setpoint[:] = robot.coupled(start + _STEP) if options.sets_positions else neutral + _STEP
    loop = Loop(options, params, slice(0, 1), arrays)
    try:
        loop.reset(np.ones(1, bool), start, np.zeros_like(start))
        loop.run(_TICKS, _SUBSTEPS, Command(arrays.command.setpoint).given)
    finally:
        loop.close()
    digest = hashlib.sha256(str(package_versions(("batchpid",)).get("batchpid")).encode())
    for name in OBSERVED:
        digest.update(getattr(arrays.observation, name).tobytes())
    return digest.hexdigest()
