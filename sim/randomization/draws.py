"""Draws of a randomization, and the generators that make them."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Float64

Episodes = NDArray[np.int64]


class Draws(NamedTuple):
    """Draws for some envs."""

    episodes: Episodes
    """Stream and episode of each env (envs, 2)."""
    values: dict[str, Float64]
    """Draws by field, e.g. "payload" or "params.kp": (envs, joints or links); NaN where nothing is drawn."""

    def for_envs(self, envs: slice | Any) -> Draws:
        """Return the draws of some envs."""
        return Draws(self.episodes[envs], {name: rows[envs] for name, rows in self.values.items()})

    def replaced(self, mask: NDArray[np.bool_], new: Draws) -> Draws:
        """Return the draws, with the envs of ``mask`` (envs,) taken from ``new``, which holds only these envs."""
        values = {name: rows.copy() for name, rows in self.values.items()}
        for name, rows in new.values.items():
            values[name][mask] = rows
        episodes = self.episodes.copy()
        episodes[mask] = new.episodes
        return Draws(episodes, values)

    def __repr__(self) -> str:
        return f"Draws({len(self.episodes)} envs, {', '.join(self.values)})"


NOTHING = Draws(np.zeros((0, 2), np.int64), {})
"""Draws of a runner without randomization."""


def generators(
    seed: int, name: str, episodes: Episodes, constant: bool, number: Any = 0
) -> Iterator[np.random.Generator]:
    """Yield a generator for each env, of draw ``number`` (an int, or one for each env) of one field in its episode."""
    digest = hashlib.blake2b(name.encode(), digest_size=8).digest()
    bits = np.random.Philox(key=np.array([seed, int.from_bytes(digest, "little")], np.uint64))
    state: Any = bits.state
    generator = np.random.Generator(bits)
    numbers = np.broadcast_to(number, len(episodes)).tolist()
    for (stream, episode), at in zip(episodes.tolist(), numbers, strict=True):
        state["state"]["counter"][:] = 0, at, 0 if constant else episode, stream
        bits.state = state  # of a new generator: the buffer is empty
        yield generator
