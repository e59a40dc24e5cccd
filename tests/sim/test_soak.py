"""Hours of simulated time: memory stays flat, and two halves joined by a snapshot are the whole."""

from __future__ import annotations

import hashlib
import os

import numpy as np
import psutil
import pytest

from sim import Recorder, Robot, Runner, Snapshot, read_recording

SECONDS = float(os.environ.get("BATCHPID_SOAK_SECONDS", "3600"))
# An hour at 2000 Hz is 0.46 billion env steps, some hours of a desktop's; a coarser step makes it fit a lunch break.
TIMESTEP = float(os.environ.get("BATCHPID_SOAK_TIMESTEP", str(1 / 2000)))
PHYSICS = os.environ.get("BATCHPID_SOAK_PHYSICS", "accurate")
N, TICK = 64, 0.1
SUBSTEPS = round(TICK / TIMESTEP)
ROBOT = Robot.load("panda")
PHASE = np.linspace(0, 2 * np.pi, N)[:, None] + np.arange(ROBOT.dof)


def memory(runner):
    """Resident bytes of this process and its workers, without what they share."""
    processes = [psutil.Process(), *map(psutil.Process, runner.pids)]
    return sum(process.memory_info().rss - process.memory_info().shared for process in processes)


def drive(runner, first, last, watch=lambda tick: None):
    """Ticks ``first`` to ``last`` of one long program: a digest of all that was observed."""
    digest = hashlib.sha256()
    middle, reach = (ROBOT.lower + ROBOT.upper) / 2, (ROBOT.upper - ROBOT.lower) / 4
    for tick in range(first, last):
        if tick % 50 == 49:
            runner.reset(mask=np.arange(N) % 10 == tick // 50 % 10)
        if tick % 300 == 299:
            runner.params = ROBOT.params(kp=30.0 + tick // 300 % 20)
        obs = runner.step(middle + reach * np.sin(PHASE + tick / 20))
        for table in obs:
            digest.update(np.ascontiguousarray(table))
        watch(tick)
    return digest.hexdigest()


@pytest.mark.slow
@pytest.mark.timeout(0)
def test_hours_leave_memory_flat_and_two_halves_make_a_whole(tmp_path):
    ticks = max(60, round(SECONDS / TICK))
    half, seen = ticks // 2, {}

    def make():
        return Runner(ROBOT, N, workers=2, timestep=TIMESTEP, physics=PHYSICS, substeps=SUBSTEPS)

    with make() as runner:

        def watch(tick):
            if tick % 10 == 0:
                seen[tick] = memory(runner)

        with Recorder(tmp_path / "run.h5", runner):
            drive(runner, 0, half, watch)
            runner.snapshot().save(tmp_path / "half.npz")
            second = drive(runner, half, ticks, watch)
        assert not runner.faults
        assert runner.recoveries == 0
    early = max(used for tick, used in seen.items() if ticks // 10 <= tick < ticks // 4)
    late = max(used for tick, used in seen.items() if tick >= 3 * ticks // 4)
    print(f"memory: {early / 2**20:.1f} MiB early, {late / 2**20:.1f} MiB late, {ticks} ticks of {N} envs")
    # It takes some minutes until all that stays has been touched.
    warming_up = 0 if ticks >= 30_000 else 8 << 20
    assert late <= 1.02 * early + warming_up
    recording = read_recording(tmp_path / "run.h5", every=max(1, ticks // 100))
    assert recording.info.complete
    assert np.ptp(recording.qpos[:, :, 0], axis=0).min() > 0.1
    with make() as runner:
        runner.restore(Snapshot.load(tmp_path / "half.npz"))
        assert drive(runner, half, ticks) == second
