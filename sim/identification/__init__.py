"""Identification of a robot's motors from logs: motion to record, logs, regression, fit and report."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from batchpid.sim.identification.identification import identify

__all__ = ["identify"]


def __getattr__(name: str) -> Any:
    if name != "identify":
        raise AttributeError(f"module 'batchpid.sim.identification' has no attribute {name!r}")
    from batchpid.sim.identification.identification import identify

    return identify
