"""Identification of a robot's motors from logs: motion to record, logs, regression, fit and report."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from batchpid.sim.identification.held_out import held_out_error
    from batchpid.sim.identification.identification import identify

__all__ = ["held_out_error", "identify"]

_MODULES = {"held_out_error": "held_out", "identify": "identification"}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'batchpid.sim.identification' has no attribute {name!r}")
    return getattr(importlib.import_module(f"batchpid.sim.identification.{_MODULES[name]}"), name)
