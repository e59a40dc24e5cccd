"""Identification of a robot's motors from logs: motion to record, logs, regression, fit and report.

Names are loaded when they are first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from batchpid.sim.identification.columns import Reading
    from batchpid.sim.identification.confidence_region import Region, draw_motors, read_region
    from batchpid.sim.identification.effort_ratios import measured_motors
    from batchpid.sim.identification.excitation import excite, is_feasible
    from batchpid.sim.identification.held_out import held_out_error
    from batchpid.sim.identification.identification import identify
    from batchpid.sim.identification.log import Log, LogWarning
    from batchpid.sim.identification.logs import logs_of_rollout, read_logs

__all__ = [
    "Log",
    "LogWarning",
    "Reading",
    "Region",
    "draw_motors",
    "excite",
    "held_out_error",
    "identify",
    "is_feasible",
    "logs_of_rollout",
    "measured_motors",
    "read_logs",
    "read_region",
]

_MODULES = {
    "columns": ("Reading",),
    "confidence_region": ("Region", "draw_motors", "read_region"),
    "effort_ratios": ("measured_motors",),
    "excitation": ("excite", "is_feasible"),
    "held_out": ("held_out_error",),
    "identification": ("identify",),
    "log": ("Log", "LogWarning"),
    "logs": ("logs_of_rollout", "read_logs"),
}
_HOMES = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'batchpid.sim.identification' has no attribute {name!r}")
    return getattr(importlib.import_module(f"batchpid.sim.identification.{_HOMES[name]}"), name)
