"""Placement of envs on workers, and of workers on cores."""

from __future__ import annotations

import os
from collections.abc import Sequence
from itertools import accumulate, pairwise


def split_envs(num_envs: int, workers: int, pack_size: int) -> list[slice]:
    """Return contiguous slices of envs, one for each worker, that do not split a pack."""
    packs = -(-num_envs // pack_size)
    return split_in_shares(num_envs, [1] * max(1, min(workers, packs)), pack_size)


def split_in_shares(num_envs: int, shares: Sequence[int], pack_size: int) -> list[slice]:
    """Return contiguous slices of envs in proportion to ``shares`` that do not split a pack; some can be empty."""
    packs, total = -(-num_envs // pack_size), sum(shares)
    cuts = [min(num_envs, pack_size * (packs * part // total)) for part in accumulate(shares, initial=0)]
    return [slice(low, high) for low, high in pairwise(cuts)]


def pinned_cores(workers: int) -> list[int]:
    """Return one core for each worker if there are as many workers as cores; else none.

    The kernel may wake two workers on the core of the parent and leave another core idle for milliseconds. Fewer
    workers than cores are not pinned: several programs could pin their workers to the same cores.
    """
    cores = sorted(os.sched_getaffinity(0))
    return cores if workers == len(cores) else []
