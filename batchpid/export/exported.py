"""Result of an export."""

from __future__ import annotations

from typing import NamedTuple


class Exported(NamedTuple):
    """Text of a file for a target, and the differences of the target's law from :func:`batchpid.step`."""

    text: str
    differences: tuple[str, ...] = ()
    """One sentence each; empty where the target computes the same law."""
