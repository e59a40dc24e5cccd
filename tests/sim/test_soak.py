"""Hours of simulated time: memory stays flat."""

import os

import numpy as np
import psutil
import pytest

from batchpid.sim import Runner

SECONDS = float(os.environ.get("BATCHPID_SOAK_SECONDS", "30"))
# These are 4 million env steps: some minutes. An hour of simulated time takes hours.
TIMESTEP = float(os.environ.get("BATCHPID_SOAK_TIMESTEP", str(1 / 2000)))
PHYSICS = os.environ.get("BATCHPID_SOAK_PHYSICS", "accurate")
NUM_ENVS, TICK = 64, 0.1


def memory(runner):
    """Return the resident bytes of this process and its workers, without shared memory."""
    processes = [psutil.Process(), *map(psutil.Process, runner.pids)]
    return sum(process.memory_info().rss - process.memory_info().shared for process in processes)


def run(runner, ticks, after_tick):
    """Run a program with resets and changes of gains."""
    robot = runner.robot
    middle, reach = (robot.lower + robot.upper) / 2, (robot.upper - robot.lower) / 4
    phase = np.linspace(0, 2 * np.pi, NUM_ENVS)[:, None] + np.arange(robot.dof)
    for tick in range(ticks):
        if tick % 50 == 49:
            runner.reset(mask=np.arange(NUM_ENVS) % 10 == tick // 50 % 10)
        if tick % 300 == 299:
            runner.params = robot.params(kp=30.0 + tick // 300 % 20)
        runner.step(middle + reach * np.sin(phase + tick / 20))
        after_tick(tick)


@pytest.mark.slow
def test_hours_leave_memory_flat(panda):
    ticks, used = max(60, round(SECONDS / TICK)), {}
    options = {"timestep": TIMESTEP, "physics": PHYSICS, "substeps": round(TICK / TIMESTEP)}
    with Runner(panda, NUM_ENVS, params=panda.params(), workers=2, **options) as runner:

        def note_memory(tick):
            if tick % 10 == 0:
                used[tick] = memory(runner)

        run(runner, ticks, note_memory)
        assert (len(runner.faults), runner.recoveries) == (0, 0)
    early = max(size for tick, size in used.items() if ticks // 10 <= tick < ticks // 4)
    late = max(size for tick, size in used.items() if tick >= 3 * ticks // 4)
    print(f"memory: {early / 2**20:.1f} MiB early, {late / 2**20:.1f} MiB late, {ticks} ticks")
    # It takes some minutes until all that stays has been touched.
    warming_up = 0 if ticks >= 30_000 else 8 << 20
    assert late <= 1.02 * early + warming_up
