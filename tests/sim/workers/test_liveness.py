"""Idle and busy time of a process: asleep and stopped ones are idle, those that wait for a core are neither."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from batchpid.sim.workers.worker import Liveness


class FakeProcess:
    """Process with a ``stat`` file that the test writes."""

    def __init__(self, folder):
        self._stat, self.now, self.cpu = folder / "stat", 100.0, 5.0
        self.liveness = Liveness(self._stat, max_gap=0.2)

    def spend(self, seconds, state, cores=0.0, every=0.1):
        """Spend time in ``state`` with a share of a core, sampled at intervals."""
        for _ in range(round(seconds / every)):
            self.now += every
            self.cpu += every * cores
            ticks = round(self.cpu * os.sysconf("SC_CLK_TCK"))
            self._stat.write_text(f"7 (a ) b) {state} 1 1 1 0 -1 0 0 0 0 0 {ticks // 2} {ticks - ticks // 2} 0 0")
            self.liveness.sample(self.now)


@pytest.fixture
def process(tmp_path):
    return FakeProcess(tmp_path)


def test_a_process_asleep_or_stopped_is_idle(process):
    process.spend(2.0, "S")
    assert process.liveness.idle == pytest.approx(1.9)  # the first sample is the start
    assert not process.liveness.stopped
    process.spend(1.0, "T")
    assert process.liveness.idle == pytest.approx(2.9)
    assert process.liveness.stopped


@pytest.mark.parametrize(("state", "busy"), [("R", 0.0), ("D", 29.9), ("t", 29.9)])
def test_a_process_that_waits_for_a_core_the_disk_or_a_debugger_is_not_idle(process, state, busy):
    process.spend(30.0, state)
    assert process.liveness.idle == 0
    assert process.liveness.busy == pytest.approx(busy)


def test_work_ends_idle_time_and_is_counted(process):
    process.spend(5.0, "S")
    process.spend(0.2, "S", cores=0.5)
    assert process.liveness.idle == 0
    busy = process.liveness.busy
    process.spend(10.0, "R", cores=0.1)
    assert process.liveness.busy - busy == pytest.approx(1.0)
    process.liveness.sample(process.now, is_first=True)
    assert process.liveness.busy == process.liveness.idle == 0


def test_a_gap_between_samples_is_not_counted(process):
    """Ctrl-Z stops parent and worker, and the parent may continue first."""
    process.spend(0.1, "R", cores=1.0)
    process.spend(60.0, "T", every=60.0)
    assert process.liveness.idle <= 0.2
    process.spend(0.1, "R", cores=1.0)
    assert process.liveness.idle == 0


def test_a_real_process_that_sleeps_becomes_idle():
    program = "import sys, time; sys.stdin.readline(); time.sleep(100)"
    with subprocess.Popen([sys.executable, "-c", program], stdin=subprocess.PIPE) as process:
        liveness = Liveness(Path(f"/proc/{process.pid}/stat"))
        deadline = time.monotonic() + 60
        while liveness.idle < 0.3:
            liveness.sample(time.monotonic())
            assert time.monotonic() < deadline
            time.sleep(0.02)
        process.kill()
    liveness.sample(time.monotonic())  # no error once it has ended
