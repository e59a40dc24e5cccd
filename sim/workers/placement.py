"""Placement of envs on workers, and of workers on cores."""

from __future__ import annotations

import os
from collections.abc import Sequence
from itertools import accumulate, pairwise


def split_in_shares(num_envs: int, shares: Sequence[int]) -> list[slice]:
    """Return contiguous slices of envs in proportion to ``shares``; some can be empty."""
    cuts = [num_envs * part // sum(shares) for part in accumulate(shares, initial=0)]
    return [slice(low, high) for low, high in pairwise(cuts)]


def pinned_cores(workers: int) -> list[int]:
    """Return one core for each worker if there are as many workers as cores; else none.

    The kernel may wake two workers on the core of the parent and leave another core idle for
    milliseconds. Fewer workers than cores are not pinned: several programs could pin their workers
    to the same cores.
    """
    cores = sorted(os.sched_getaffinity(0))
    if workers == len(cores):
        return cores
    return []
