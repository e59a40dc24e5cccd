"""Placement of envs on workers, and of workers on cores."""

from __future__ import annotations

import os
from itertools import pairwise


def split_envs(num_envs: int, workers: int, pack_size: int) -> list[slice]:
    """Return contiguous slices of envs, one for each worker, that do not split a pack."""
    packs = -(-num_envs // pack_size)
    count = max(1, min(workers, packs))
    cuts = [min(num_envs, pack_size * (packs * k // count)) for k in range(count + 1)]
    return [slice(low, high) for low, high in pairwise(cuts)]


def pinned_cores(workers: int) -> list[int]:
    """Return one core for each worker if there are as many workers as cores; else none.

    The kernel may wake two workers on the core of the parent and leave another core idle for milliseconds. Fewer
    workers than cores are not pinned: those of several programs could get the same cores.
    """
    cores = sorted(os.sched_getaffinity(0))
    return cores if workers == len(cores) else []
