import os
import resource
from pathlib import Path

import pytest
from robots import load_bundled

from batchpid.errors import WorkerError
from batchpid.sim import Runner
from batchpid.sim.workers.exchange import SharedArrays


@pytest.mark.parametrize("workers", [0, 1])
def test_a_closed_runner_keeps_no_descriptor(workers):
    def count():
        links = [Path("/proc/self/fd") / name for name in os.listdir("/proc/self/fd")]
        return sum("memfd" in os.readlink(link) for link in links if link.is_symlink())

    robot = load_bundled("panda")
    with Runner(robot, 1, workers=workers) as runner:
        runner.step(robot.settings.target)
    before, kept = count(), []
    for _ in range(2):
        with Runner(robot, 1, workers=workers) as runner:
            runner.step(robot.settings.target)
        kept.append(runner)
    assert count() <= before


def test_memory_beyond_the_limit_of_file_sizes_is_an_error_with_the_remedy():
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    try:
        with pytest.raises(WorkerError, match="ulimit -f"):
            SharedArrays({"rows": ((1000,), "f8")})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
