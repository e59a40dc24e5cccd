"""Identification of a robot's motors from logs: motion to record, logs, regression, fit and report.

Names are loaded when they are first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from batchpid.sim.identification.excitation import excite
    from batchpid.sim.identification.identification import identify
    from batchpid.sim.identification.log import Log, LogSettings, LogWarning
    from batchpid.sim.identification.logs import Reading, logs_of_rollout, read_logs
    from batchpid.sim.identification.result import draw_motors

__all__ = [
    "Log",
    "LogSettings",
    "LogWarning",
    "Reading",
    "draw_motors",
    "excite",
    "identify",
    "logs_of_rollout",
    "read_logs",
]

_MODULES = {
    "excitation": ("excite",),
    "identification": ("identify",),
    "log": ("Log", "LogSettings", "LogWarning"),
    "logs": ("Reading", "logs_of_rollout", "read_logs"),
    "result": ("draw_motors",),
}
_HOMES = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'batchpid.sim.identification' has no attribute {name!r}")
    return getattr(importlib.import_module(f"batchpid.sim.identification.{_HOMES[name]}"), name)
