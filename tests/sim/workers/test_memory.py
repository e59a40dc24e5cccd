"""A runner that does not fit into memory is refused before anything is built."""

from __future__ import annotations

import re
import resource
import subprocess
import sys
from contextlib import contextmanager

import psutil
import pytest
from processes import children
from robots import load_bundled

from batchpid.errors import InvalidArgumentError
from batchpid.sim import Runner

ROBOT = load_bundled("panda")


@contextmanager
def address_space(size):
    """Limit the virtual memory of this process [bytes]."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


@pytest.mark.parametrize("workers", [0, 2])
def test_more_envs_than_the_memory_limit_allows_are_refused(workers):
    others, used = children(), psutil.Process().memory_info().vms
    with (
        address_space(used + (2 << 30)),
        pytest.raises(InvalidArgumentError, match=r"num_envs: needs \d.* GB of memory or more, .*got 1000000.*such as"),
    ):
        Runner(ROBOT, 1_000_000, params=ROBOT.params(), workers=workers)
    assert children() == others


def test_more_envs_than_the_machine_has_memory_for_are_refused():
    count = psutil.virtual_memory().total // 150_000
    if count > 1_000_000:
        pytest.skip("a million envs fit into this machine")
    with pytest.raises(InvalidArgumentError, match=r"num_envs: needs .* GB") as info:
        Runner(ROBOT, count, params=ROBOT.params(), workers=0)
    smaller = int(re.search(r"such as ([\d,]+)", str(info.value))[1].replace(",", ""))
    assert 0 < smaller < count


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["sapien", "mujoco"])
def test_the_estimate_is_below_what_the_envs_take_but_not_far(engine):
    pytest.importorskip("mujoco.batch" if engine == "mujoco" else "sapien")
    program = (  # a new process, so that no memory is reused
        "import psutil, warnings; warnings.simplefilter('ignore'); from sim import Robot, Runner\n"
        "from batchpid.sim.workers.placement import estimate_memory\n"
        "robot = Robot.load('jaco2'); "
        f"options = dict(params=robot.params(), workers=0, engine={engine!r})\n"
        "rss = lambda: psutil.Process().memory_info().rss\n"
        "with Runner(robot, 1, **options): before = rss()\n"
        "with Runner(robot, 200, **options) as runner:\n"
        "    runner.step(robot.start)\n"
        "    print(estimate_memory(runner.options, 200) / (rss() - before))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert 0.5 < float(done.stdout) < 1.0
