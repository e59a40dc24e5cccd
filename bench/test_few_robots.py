"""Few robots in the caller's process, compared with the tutorial's loop: time of an env step,
measured in turn.
"""

import statistics

import pytest
from shared_ratios import COUNTS, few_robots


@pytest.mark.parametrize("num_envs", COUNTS)
@pytest.mark.parametrize("physics", ["accurate", "fast"])
@pytest.mark.parametrize("name", ["panda", "jaco2"])
def test_few_robots(benchmark, report, compare, most, name, physics, num_envs):
    benchmark.group = "few robots in the caller's process"
    seconds = benchmark.pedantic(lambda: few_robots(name, num_envs, physics, most), rounds=1)
    report([ours for ours, _ in seconds])
    ratio = statistics.median(theirs / ours for ours, theirs in seconds)
    benchmark.extra_info["over_tutorial"] = round(ratio, 3)
    compare(
        f"{name}, {physics}, in one process", f"closed loop, {num_envs} envs", "tutorial", ratio
    )
