"""An exception at any moment of a call leaves runner, recording and snapshots as before the call, or as after it."""

from __future__ import annotations

import os
import random

import numpy as np
import pytest
from twin import ROBOT, SUBSTEPS, CtrlC, InterruptAt, N, Twin, nothing_left

INTERRUPTS = int(os.environ.get("BATCHPID_SOAK_INTERRUPTS", "100"))
NEAR = 0.9 * ROBOT.start + 0.1 * ROBOT.settings.target
SETPOINTS = np.tile(ROBOT.settings.target, (12, 1))
FIRST = np.arange(N) == 0
NAMES = ("step", "exchange", "rollout", "set_params", "reset", "snapshot", "restore", "record", "reopen", "construct")


def call(twin, name, disturb):
    """Execute one command on ``twin``."""
    arguments = {
        "step": (SETPOINTS[0],),
        "exchange": (SETPOINTS[0],),
        "rollout": (SETPOINTS,),
        "set_params": (ROBOT.params(kp=25.0 + twin.runner.time),),
        "reset": (NEAR, FIRST),
    }
    if name == "restore":
        if not twin.snapshots:
            twin.snapshot()
        twin.step(SETPOINTS[0])
        arguments[name] = (twin.snapshots[-1],)
    getattr(twin, name)(*arguments.get(name, ()), disturb)


def interrupt_at_moments(twin, name, first, stride):
    """Interrupt a command at every ``stride``-th moment; return how often."""
    moment, missed = first, 0
    while missed < 2:  # "record" begins and ends a recording in turns
        disturb = InterruptAt(moment)
        try:
            call(twin, name, disturb)
        except Exception as error:
            error.add_note(f"interrupted at {disturb.where}")
            raise
        missed = 0 if disturb.happened else missed + 1
        moment += stride
    return (moment - first) // stride - missed


def test_commands_interrupted_at_some_moments_are_done_or_not_begun(tmp_path):
    chance = random.Random(0)
    with nothing_left():
        twin = Twin(tmp_path, workers=0)
        for name in NAMES:
            call(twin, name, InterruptAt(chance.randrange(1, 120)))
        twin.close()


@pytest.mark.slow
@pytest.mark.parametrize("workers", [0, 1])
@pytest.mark.parametrize("name", NAMES)
def test_a_command_interrupted_at_every_moment_is_done_or_not_begun(name, workers, tmp_path):
    with nothing_left():
        twin = Twin(tmp_path, workers)
        twin.record()
        assert interrupt_at_moments(twin, name, 1, 1 + 6 * workers) > 1
        twin.close()


def interrupt_at_random(count, workers, folder):
    chance, ctrl_c = random.Random(count), CtrlC()
    with nothing_left():
        twin = Twin(folder, workers)
        for number in range(count):
            name = NAMES[number % len(NAMES)]
            call(twin, name, ctrl_c.after(chance.uniform(0, 0.3 if name == "reopen" and workers else 4e-3 * SUBSTEPS)))
        twin.close()
    return ctrl_c.happened


def test_ctrl_c_at_some_moments(tmp_path):
    assert interrupt_at_random(5, 1, tmp_path) == 5


@pytest.mark.slow
@pytest.mark.parametrize("workers", [0, 2])
def test_ctrl_c_at_random_moments(workers, tmp_path):
    assert interrupt_at_random(INTERRUPTS, workers, tmp_path) == INTERRUPTS
