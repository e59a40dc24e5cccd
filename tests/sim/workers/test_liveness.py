"""A process that is stuck is told from one that works, waits for a core, or was not looked at."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from sim.workers.liveness import Liveness


class Fake:
    """A process of which the test says what the kernel would."""

    def __init__(self, tmp_path):
        self._stat, self.now, self.cpu = tmp_path / "stat", 100.0, 5.0
        self.liveness = Liveness(self._stat, max_gap=0.2)

    def live(self, seconds, state, share=0.0, every=0.1):
        """Let it be in ``state`` with that share of a processor, looked at now and then."""
        for _ in range(round(seconds / every)):
            self.now += every
            self.cpu += every * share
            ticks = round(self.cpu * os.sysconf("SC_CLK_TCK"))
            self._stat.write_text(f"7 (a ) b) {state} 1 1 1 0 -1 0 0 0 0 0 {ticks // 2} {ticks - ticks // 2} 0 0")
            self.liveness.sample(self.now)


@pytest.fixture
def process(tmp_path):
    return Fake(tmp_path)


def test_asleep_and_stopped_are_idle(process):
    process.live(2.0, "S")
    assert process.liveness.idle == pytest.approx(1.9)  # the first look is where it starts
    assert not process.liveness.stopped
    process.live(1.0, "T")
    assert process.liveness.idle == pytest.approx(2.9)
    assert process.liveness.stopped


@pytest.mark.parametrize("state", ["R", "D", "t"])
def test_what_waits_for_a_core_the_disk_or_a_debugger_is_not(process, state):
    process.live(30.0, state)
    assert process.liveness.idle == 0
    assert process.liveness.busy == pytest.approx(0.0 if state == "R" else 29.9)


def test_work_ends_idleness_and_counts(process):
    process.live(5.0, "S")
    process.live(0.2, "S", share=0.5)
    assert process.liveness.idle == 0
    busy = process.liveness.busy
    process.live(10.0, "R", share=0.1)
    assert process.liveness.busy - busy == pytest.approx(1.0)
    process.liveness.begin()
    assert process.liveness.busy == process.liveness.idle == 0


def test_time_in_which_nobody_looked_does_not_count(process):
    """Ctrl-Z stops parent and worker alike, and the parent may go on first."""
    process.live(0.1, "R", share=1.0)
    process.live(60.0, "T", every=60.0)
    assert process.liveness.idle <= 0.2
    process.live(0.1, "R", share=1.0)
    assert process.liveness.idle == 0


def test_a_real_process():
    program = "import sys, time; sys.stdin.readline(); time.sleep(100)"
    with subprocess.Popen([sys.executable, "-c", program], stdin=subprocess.PIPE) as process:
        liveness = Liveness(Path(f"/proc/{process.pid}/stat"))
        deadline = time.monotonic() + 60
        while liveness.idle < 0.3:
            liveness.sample(time.monotonic())
            assert time.monotonic() < deadline
            time.sleep(0.02)
        process.kill()
    liveness.sample(time.monotonic())  # gone: nothing new
