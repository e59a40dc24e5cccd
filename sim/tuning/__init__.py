"""Gains: moves to evaluate them on, their evaluation, and the search for them; motors, identified from logs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sim.tuning.identification.identify import identify

__all__ = ["identify"]


def __getattr__(name: str) -> Any:
    if name != "identify":
        raise AttributeError(f"module 'sim.tuning' has no attribute {name!r}")
    from sim.tuning.identification.identify import identify

    return identify
