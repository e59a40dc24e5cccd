"""Tables of vectors for native code, which steps WIDTH robots at once: (blocks, columns, WIDTH)."""

from __future__ import annotations

import numpy as np

from batchpid.arrays.array_types import Float64, Rows
from batchpid.sim.engine.native.interface import WIDTH

_ALIGNMENT = 64
"""Alignment of vectors in memory [bytes]."""


def aligned(*shape: int) -> Float64:
    """Return an array of zeros whose memory begins where a vector may."""
    size = 8 * int(np.prod(shape))
    memory = np.zeros(size + _ALIGNMENT, np.uint8)
    start = -memory.ctypes.data % _ALIGNMENT
    rows: Float64 = memory[start : start + size].view(np.float64).reshape(shape)
    return rows


def table(rows: Rows, size: int) -> Float64:
    """Return ``rows`` (size | 1, columns) in blocks (blocks, columns, WIDTH)."""
    blocks = -(-size // WIDTH)
    out = aligned(blocks, rows.shape[1], WIDTH)
    padded = np.broadcast_to(rows, (size, rows.shape[1]))[
        np.minimum(np.arange(blocks * WIDTH), size - 1)
    ]
    out[...] = padded.reshape(blocks, WIDTH, -1).swapaxes(1, 2)
    return out
