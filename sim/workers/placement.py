"""Placement of envs on workers, of workers on cores, and the memory that they take."""

from __future__ import annotations

import os
import resource
from collections.abc import Iterator, Sequence
from itertools import accumulate, pairwise
from pathlib import Path

from batchpid.errors import InvalidArgumentError
from batchpid.sim.options import RunnerOptions

WORKER_BYTES = 130_000_000
"""Resident bytes of a worker process without envs: SAPIEN and NumPy."""
WORKER_ADDRESS_SPACE = 470_000_000
"""Virtual memory of a worker process without envs [bytes], of which most is not resident."""

_CGROUPS = Path("/sys/fs/cgroup")


def split_envs(num_envs: int, workers: int) -> list[slice]:
    """Return contiguous slices of envs, one for each worker; none is empty."""
    return split_in_shares(num_envs, [1] * max(1, min(workers, num_envs)))


def split_in_shares(num_envs: int, shares: Sequence[int]) -> list[slice]:
    """Return contiguous slices of envs in proportion to ``shares``; some can be empty."""
    cuts = [num_envs * part // sum(shares) for part in accumulate(shares, initial=0)]
    return [slice(low, high) for low, high in pairwise(cuts)]


def pinned_cores(workers: int) -> list[int]:
    """Return one core for each worker if there are as many workers as cores; else none.

    The kernel may wake two workers on the core of the parent and leave another core idle for milliseconds. Fewer
    workers than cores are not pinned: several programs could pin their workers to the same cores.
    """
    cores = sorted(os.sched_getaffinity(0))
    return cores if workers == len(cores) else []


def estimate_memory(options: RunnerOptions, num_envs: int) -> int:
    """Return a lower estimate of the bytes that ``num_envs`` of a runner's envs take."""
    return options.load_engine().least_memory(num_envs, options.robot.dof)


def check_memory(options: RunnerOptions, num_envs: int, workers: int, is_local: bool) -> None:
    """Check that ``num_envs`` of the envs fit into the memory of this machine and the limits of this process.

    Raises InvalidArgumentError if not.
    """
    envs, count = estimate_memory(options, num_envs), 0 if is_local else workers
    needs = [(envs + count * WORKER_BYTES, available) for available in (_free_memory(), *_cgroup_memory())]
    space = _address_space()
    if space is not None:
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        largest = -(-num_envs // workers)
        needs.append((used + envs if is_local else WORKER_ADDRESS_SPACE + estimate_memory(options, largest), space))
    for needed, available in needs:
        if needed > available:
            raise InvalidArgumentError(
                "num_envs",
                f"needs {needed / 1e9:.2g} GB of memory or more, of which {max(available, 0) / 1e9:.2g} GB are "
                "available",
                value=num_envs,
                remedy=f"pass a smaller one, such as {_fitting(options, num_envs, available * envs // needed):,}",
            )


def _fitting(options: RunnerOptions, num_envs: int, available: int) -> int:
    """Return a round number of envs that need at most half of ``available`` bytes."""
    count = max(1, num_envs * max(available, 0) // (2 * estimate_memory(options, num_envs)))
    digits = 10 ** (len(str(count)) - 1)
    return count // digits * digits


def _free_memory() -> int:
    """Return the bytes that the system can still give to programs."""
    lines = (line.split() for line in Path("/proc/meminfo").read_text().splitlines())
    sizes = {line[0]: int(line[1]) * 1024 for line in lines}
    return sizes["MemAvailable:"] + sizes["SwapFree:"]


def _cgroup_memory() -> Iterator[int]:
    """Yield the bytes left under each memory limit of this process's control groups, such as those of a container."""
    for line in Path("/proc/self/cgroup").read_text().splitlines():
        _, controllers, path = line.split(":", 2)
        names = ("limit_in_bytes", "usage_in_bytes") if controllers else ("max", "current")
        total = "total_" if controllers else ""
        if controllers and "memory" not in controllers.split(","):
            continue
        root = _CGROUPS / ("memory" if controllers else "")
        for folder in (Path(path), *Path(path).parents):
            try:
                here = root / folder.relative_to("/")
                limit, used = ((here / f"memory.{name}").read_text() for name in names)
                stat = dict(line.split() for line in (here / "memory.stat").read_text().splitlines())
                cached = sum(int(stat.get(f"{total}{kind}_file", 0)) for kind in ("active", "inactive"))
                yield int(limit) - int(used) + cached
            except (OSError, ValueError):  # no such file, or the limit is "max"
                continue


def _address_space() -> int | None:
    """Return the limit of this process' virtual memory [bytes], which its children inherit; None means unlimited."""
    limits = [resource.getrlimit(kind)[0] for kind in (resource.RLIMIT_AS, resource.RLIMIT_DATA)]
    return min((limit for limit in limits if limit != resource.RLIM_INFINITY), default=None)
